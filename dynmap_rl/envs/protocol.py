"""The protocol of tasks: what recording, training and evaluation ask of an environment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Layout:
    """Sizes and names of what an episode of a task holds.

    Attributes:
        steps: control steps T of an episode.
        fps: control steps per second.
        action: names of the A entries of an action.
        action_limit: largest magnitude of each entry of an action.
        state: names of the entries of ``agent_pos``; those of the goal begin with ``goal_`` and stand last.
        position: names of the P entries of the position of all bodies, orientations included.
        velocity: names of the V entries of velocity and acceleration.
        image_size: side of a frame in pixels.
        cameras: names of the cameras; their frames stand side by side in ``pixels``.
        robot: what the actions move, as datasets name it.

    Raises:
        ValueError: ``state`` does not end with the goal, or ``action`` and ``action_limit`` have different lengths.
    """

    steps: int
    fps: int
    action: tuple[str, ...]
    action_limit: tuple[float, ...]
    state: tuple[str, ...]
    position: tuple[str, ...]
    velocity: tuple[str, ...]
    image_size: int = 64
    cameras: tuple[str, ...] = ("front",)
    robot: str = "dynmap_cart"

    def __post_init__(self):
        goal = [name for name in self.state if name.startswith("goal_")]
        if not goal or list(self.state[-len(goal) :]) != goal:
            raise ValueError(f"state must end with the entries of the goal, named goal_..., got {self.state}")
        if len(self.action) != len(self.action_limit):
            raise ValueError(f"action_limit must have {len(self.action)} entries, got {self.action_limit}")

    @property
    def dt(self) -> float:
        """Duration of a control step (s)."""
        return 1 / self.fps

    @property
    def goal_size(self) -> int:
        """Number of entries of the goal."""
        return sum(name.startswith("goal_") for name in self.state)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Shape of ``pixels`` of a step: RGB, height, and the width of all cameras."""
        return 3, self.image_size, self.image_size * len(self.cameras)

    @property
    def dynamics(self) -> dict[str, tuple[str, ...]]:
        """Names of the entries of every quantity of the dynamics."""
        return {"position": self.position, "velocity": self.velocity, "acceleration": self.velocity}

    def to_dict(self) -> dict[str, Any]:
        """Return all entries by their names, for JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Layout:
        """Make a layout from the entries that :meth:`to_dict` returned.

        Raises:
            ValueError: an entry is missing or unknown.
        """
        if set(values) != (names := {f.name for f in fields(cls)}):
            raise ValueError(f"a layout must have the entries {sorted(names)}, got {sorted(values)}")
        return cls(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


class SimulatedWorld(Protocol):
    """State of one episode.

    Attributes:
        position: ``[P]`` (m; orientations as the task's layout names them).
        velocity: ``[V]`` (m/s, rad/s).
        acceleration: change of the velocity over the last control step, divided by its duration; 0 at the start.
        steps: number of control steps so far.
        position_error: distance to the goal by which a task is judged (m).
        dropped: whether the object was ever lost.
        touched: what was ever touched that must not be; empty for tasks without such things.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    steps: int
    position_error: float
    dropped: bool
    touched: set[str]


class BaseTask(ABC):
    """Interface between a task and the pipeline, for any simulator.

    :class:`dynmap_rl.envs.Task` implements it for carts and blocks in the plane, and
    :class:`dynmap_rl.envs.mujoco.MujocoTask` for Gymnasium environments with MuJoCo. For another simulator, write a
    subclass and a class of worlds (see :class:`SimulatedWorld`). ``"your_module:YourTask"`` then names the task in
    :class:`dynmap_rl.envs.DynmapBatchedEnv` and in the recipes.

    A task has no state of its own: one instance serves many worlds.

    Attributes:
        name: lower case with underscores; folders and datasets are named after it.
        description: instruction in one sentence; datasets store it as LeRobot's ``task``.
        layout: sizes and names.
        ranges: ranges of the scenes that a user can narrow, or None.
        symmetric: whether a demonstration that is mirrored left to right, or shifted, is a demonstration of the task.
        planar: whether frames are flat pictures of the plane that recolouring, mirroring and shifting keep in agreement
            with the dynamics. World models of other tasks are trained without augmentation.
        max_worlds: number of worlds that fit into memory at a time; None for any number.
        state_size: number of entries S of ``state``.
    """

    ranges: Any = None
    symmetric: bool = False
    planar: bool = False
    max_worlds: int | None = None

    @property
    @abstractmethod
    def name(self) -> str:
        """Name of the task; a class attribute in subclasses."""

    @property
    @abstractmethod
    def description(self) -> str:
        """Instruction in one sentence; a class attribute in subclasses."""

    @property
    @abstractmethod
    def layout(self) -> Layout:
        """Sizes and names of what an episode holds."""

    @property
    @abstractmethod
    def state_size(self) -> int:
        """Number of entries S of ``state``."""

    @abstractmethod
    def begin(self, seed: int, ranges: Any = None, world: Any = None) -> Any:
        """Return a world at the start of the episode that ``seed`` determines.

        Args:
            seed: seed of the scene.
            ranges: ranges of the scene, of the type of ``self.ranges``; by default the task's own.
            world: world that is no longer needed and whose simulator may be used again.
        """

    @abstractmethod
    def step(self, worlds: Sequence[Any], actions: np.ndarray | Sequence[np.ndarray]) -> None:
        """Simulate one control step of every world with its action ``[A]``.

        The actions of a task of another simulator than cart and block lie within ``layout.action_limit``: environments and
        recordings cut them.
        """

    @abstractmethod
    def make_renderer(self) -> Callable[[Any], np.ndarray]:
        """Return the function that draws a world, uint8 ``[image_size, cameras * image_size, 3]``.

        Raises:
            OSError: nothing can be drawn on this machine.
        """

    @abstractmethod
    def agent_pos(self, world: Any) -> np.ndarray:
        """Return all that a policy may read besides the frame; its last entries are the goal."""

    @abstractmethod
    def state(self, world: Any) -> np.ndarray:
        """Return the privileged observation for experts, float32 ``[S]``."""

    @abstractmethod
    def reward(self, world: Any) -> float:
        """Return the reward of the last step."""

    @abstractmethod
    def is_success(self, world: Any) -> bool:
        """Return whether the episode would be a success if it ended with the last step."""

    def is_over(self, world: Any) -> bool:
        """Return whether the episode has failed for good before its last step."""
        return False

    def close(self, world: Any) -> None:
        """Close the simulator of a world that is no longer needed; by default there is nothing to close."""
        return None

    def describe(self, seed: int) -> dict[str, Any]:
        """Return the scene of a seed as JSON values, for the metadata of an episode."""
        return {}

    def demonstrator(self, world: Any) -> Callable[[], np.ndarray] | None:
        """Return a function that returns the expert's next action ``[A]`` in this world, to be called in every step.

        Recordings add noise to some demonstrations, but not while the function has a true attribute ``exact``. A task
        without this method has trained networks for experts (see :mod:`dynmap_rl.experts`).
        """
        return None

    def person_action(self, world: Any, direction: np.ndarray) -> np.ndarray:
        """Return the action ``[A]`` of a person who presses keys in the play window.

        Args:
            world: world that the person sees.
            direction: ``[3]`` of -1 to 1: to the right and to the top of the picture, and up (key Q).
        """
        limit = np.array(self.layout.action_limit)
        return limit * np.resize(direction, len(limit)) * (np.arange(len(limit)) < len(direction))

    @property
    def has_demonstrator(self) -> bool:
        """Whether the task has a demonstrator."""
        return type(self).demonstrator is not BaseTask.demonstrator


def check_action(action: Any, size: int, what: str = "an action") -> np.ndarray:
    """Return an action as float32 ``[size]``.

    Raises:
        ValueError: it has another shape, or is not finite; the message begins with ``what``.
    """
    action = np.asarray(action, dtype=np.float32)
    if action.shape != (size,) or not np.isfinite(action).all():
        raise ValueError(f"{what} must be {size} finite numbers, got {action}")
    return action


def check_world(
    task: BaseTask, world: SimulatedWorld, frame: np.ndarray | None = None, state: bool = True
) -> None:
    """Check the sizes of what a task returns against its layout.

    Args:
        task: the task.
        world: one of its worlds, at the start of an episode.
        frame: what the task's renderer has drawn.
        state: whether the state is checked too.

    Raises:
        ValueError: a size differs, or the frame is not uint8.
    """
    layout, (channels, height, width) = task.layout, task.layout.frame_shape
    found = {"agent_pos": (task.agent_pos(world), (len(layout.state),))}
    found |= {name: (getattr(world, name), (len(entries),)) for name, entries in layout.dynamics.items()}
    if state:
        found["state"] = task.state(world), (task.state_size,)
    if frame is not None:
        found["frame"] = frame, (height, width, channels)
    for name, (value, shape) in found.items():
        if np.shape(value) != shape:
            raise ValueError(
                f"{name} of the task {task.name} must have the shape {shape}, got {np.shape(value)}"
            )
    if frame is not None and frame.dtype != np.uint8:
        raise ValueError(f"the frames of the task {task.name} must be uint8, got {frame.dtype}")
