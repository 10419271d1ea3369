"""A Gymnasium environment with MuJoCo as a task."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import cached_property
from numbers import Real
from typing import Any

import gymnasium
import mujoco
import numpy as np

from ..protocol import BaseTask, Layout, check_action
from .bodies import Body
from .rendering import Camera, FrameRenderer, find_heavy, find_parts, free_unused
from .world import MujocoWorld

SIZES = 64, 96, 128
RESCALE = "wrap the environment in gymnasium.wrappers.RescaleAction(env, -1, 1)"
ATTEMPTS = 100  # of a start that is not solved yet


class MujocoTask(BaseTask):
    """Task of a Gymnasium environment with MuJoCo.

    A subclass must define ``name``, ``description``, ``bodies``, ``views``, ``steps``, ``fps``, ``make`` and ``goal``.
    The environment may be any whose ``unwrapped`` has ``model`` and ``data`` and whose actions are a box that is
    symmetric about 0. Success is ``info["is_success"]`` or ``info["success"]`` after a step; override :meth:`is_solved`
    where ``info`` has neither, or where ``reset`` does not return it and a start may be solved already.

    Args:
        image_size: side of a frame in pixels: 64, 96 or 128.
        cameras: number of cameras, the first of ``views``.
        arm: draw meshes of more than 2,000 faces, which slows recording down by a factor of 2 to 3. Parts that are made
            of such meshes are not visible otherwise; of the arm of Meta-World the hand remains.

    Attributes:
        bodies: bodies whose dynamics are recorded; first the object whose distance to the goal is judged, last the one
            that the actions move, whose position a policy may read.
        views: cameras.
        steps: control steps of an episode.
        fps: control steps per second.
        action: names of the entries of an action.
        action_limit: largest magnitude of the entries.
        keep: bodies whose meshes are always drawn.
        hide: bodies that are never drawn, such as those that show a controller's targets.
        robot: what the actions move, as datasets name it.

    Raises:
        ValueError: an argument is wrong.
    """

    bodies: tuple[Body, ...]
    views: tuple[Camera, ...]
    steps: int
    fps: int
    action: tuple[str, ...] = ("x", "y", "z", "gripper")
    action_limit: float = 1.0
    keep: tuple[str, ...] = ()
    hide: tuple[str, ...] = ()
    robot: str = "mujoco"
    max_worlds = 16

    def __init__(self, image_size: int = 64, cameras: int = 1, arm: bool = False):
        names = "name", "description", "bodies", "views", "steps", "fps"
        if missing := [name for name in names if not hasattr(self, name)]:
            raise ValueError(f"{type(self).__name__} must define {', '.join(missing)}")
        if not re.fullmatch("[a-z0-9_]+", self.name):
            raise ValueError(f"name must be of lower-case letters, digits and underscores, got {self.name!r}")
        for name in ("steps", "fps"):
            if (value := getattr(self, name)) != int(value) or value < 1:
                raise ValueError(
                    f"{name} must be a whole number of at least 1, got {value}; fps depends on the environment's "
                    "frame_skip"
                )
        if not isinstance(self.action_limit, Real):
            raise ValueError(f"action_limit must be a number, got {self.action_limit!r}; {RESCALE}")
        for name, kind in (("bodies", Body), ("views", Camera)):
            values = getattr(self, name)
            if not (isinstance(values, tuple) and values and all(isinstance(some, kind) for some in values)):
                raise ValueError(f"{name} must be a tuple of {kind.__name__}, got {values!r}")
            if len({some.name for some in values}) < len(values):
                raise ValueError(f"{name} must have different names, got {[some.name for some in values]}")
        if len(set(self.action)) < len(self.action):
            raise ValueError(f"action must have different names, got {self.action}")
        if bad := [body.name for body in self.bodies if body.name == "goal" or body.name.startswith("goal_")]:
            raise ValueError(f"names of bodies must not be goal or begin with goal_, got {bad}")
        if bad := [view.name for view in self.views if not re.fullmatch("[A-Za-z0-9_]+", view.name)]:
            raise ValueError(f"names of views must be of letters, digits and underscores, got {bad}")
        if not isinstance(image_size, int) or image_size not in SIZES:
            raise ValueError(f"image_size must be one of {SIZES}, got {image_size!r}")
        if not isinstance(cameras, int) or cameras not in range(1, len(self.views) + 1):
            raise ValueError(f"cameras must be 1 to {len(self.views)}, got {cameras!r}")
        if not isinstance(arm, bool):
            raise ValueError(f"arm must be true or false, got {arm!r}")
        self.image_size, self.cameras, self.arm = image_size, self.views[:cameras], arm

    @abstractmethod
    def make(self) -> gymnasium.Env:
        """Make the environment."""

    @abstractmethod
    def goal(self, world: MujocoWorld) -> np.ndarray:
        """Return the goal on which policies are conditioned, ``[3]``: x, y and z (m)."""

    def reset(self, env: gymnasium.Env, seed: int) -> tuple[Any, dict]:
        """Reset the environment to the start that ``seed`` determines; return observation and info."""
        return env.reset(seed=seed % 2**32)

    def prepare(self, world: MujocoWorld) -> None:
        """Bring everything that is drawn into place after a reset, such as a marker of the goal."""
        mujoco.mj_forward(world.model, world.data)

    def is_solved(self, world: MujocoWorld) -> bool:
        """Return whether the goal is reached now.

        Raises:
            ValueError: the environment's ``info`` does not say so after a step.
        """
        found = world.info.get("is_success", world.info.get("success"))
        if found is None and world.steps:
            raise ValueError(f"info of {self.name} must have is_success or success; or override is_solved")
        return bool(found)

    def is_dropped(self, world: MujocoWorld) -> bool:
        """Return whether the object is lost."""
        return False

    def is_success(self, world: MujocoWorld) -> bool:
        return self.is_solved(world)

    @cached_property
    def layout(self) -> Layout:
        """Sizes and names."""
        agent = self.bodies[-1].name
        return Layout(
            steps=self.steps,
            fps=self.fps,
            action=self.action,
            action_limit=(self.action_limit,) * len(self.action),
            state=tuple(f"{name}_{axis}" for name in (agent, "goal") for axis in "xyz"),
            position=tuple(name for body in self.bodies for name in body.position_names),
            velocity=tuple(name for body in self.bodies for name in body.velocity_names),
            image_size=self.image_size,
            cameras=tuple(camera.name for camera in self.cameras),
            robot=self.robot,
        )

    @property
    def state_size(self) -> int:
        """Number of entries of position, velocity and goal."""
        return len(self.layout.position) + len(self.layout.velocity) + 3

    def begin(self, seed: int, ranges: None = None, world: MujocoWorld | None = None) -> MujocoWorld:
        """Reset an environment; starts that are solved already are left out.

        Raises:
            ValueError: the environment does not fit the task, or every start is solved already.
        """
        world = world or self._make_world()
        observation, info = self.reset(world.env, seed)
        for _ in range(ATTEMPTS):
            world.attach()
            self.prepare(world)
            world.check_places()
            world.begin(observation, info)
            goal = np.asarray(self.goal(world))
            if goal.shape != (3,) or not np.isfinite(goal).all():
                got = goal if goal.shape == (3,) else list(goal.shape)
                raise ValueError(f"goal of {self.name} must return finite x, y and z, [3], got {got}")
            world.position_error = self.distance(world)
            if not self.is_solved(world):
                return world
            if type(self).reset is MujocoTask.reset:
                observation, info = world.env.reset()  # the next start of the same seed
            else:  # env.reset alone may lack what the task's own reset does
                seed = int(np.random.default_rng(seed % 2**32).integers(2**32))
                observation, info = self.reset(world.env, seed)
        raise ValueError(f"{self.name} must have starts that are not solved, got {ATTEMPTS} solved ones")

    def _make_world(self) -> MujocoWorld:
        env = self.make()
        world, size = MujocoWorld(env, self.bodies, 1 / self.fps), len(self.action)
        box = env.action_space
        if box.shape != (size,) or not np.allclose([box.high, -box.low], self.action_limit):
            raise ValueError(
                f"{self.name} must have actions of {size} entries within {self.action_limit}, got {env.action_space}; "
                f"name them in action, and set action_limit, or {RESCALE}"
            )
        return world

    def step(self, worlds: Sequence[MujocoWorld], actions: Sequence[np.ndarray]) -> None:
        """Simulate one control step of every world with its action ``[A]``, cut to the limits."""
        actions = [check_action(action, len(self.action)) for action in actions]
        for world, action in zip(worlds, actions, strict=True):
            world.step(action.clip(-self.action_limit, self.action_limit))
            world.position_error = self.distance(world)
            world.solved |= self.is_solved(world)
            world.dropped |= self.is_dropped(world)

    def make_renderer(self) -> Callable[[MujocoWorld], np.ndarray]:
        return self._draw

    def _draw(self, world: MujocoWorld) -> np.ndarray:
        if world.renderer is None:
            model = world.model
            hide = [] if self.arm else find_heavy(model, self.keep)
            hide += np.flatnonzero(np.isin(model.geom_bodyid, list(find_parts(model, self.hide)))).tolist()
            world.renderer = FrameRenderer(model, self.cameras, self.image_size, hide)
        return world.renderer.draw(world.data)

    def close(self, world: MujocoWorld) -> None:
        world.env.close()
        world.renderer = None
        free_unused()

    def distance(self, world: MujocoWorld) -> float:
        """Return the distance of the object to the goal (m)."""
        return float(np.linalg.norm(world.position[:3] - self.goal(world)))

    def agent_pos(self, world: MujocoWorld) -> np.ndarray:
        """Return the position of the last body, and the goal, ``[6]`` (m)."""
        start = len(self.layout.position) - len(self.bodies[-1].position_names)
        return np.concatenate([world.position[start : start + 3], self.goal(world)])

    def state(self, world: MujocoWorld) -> np.ndarray:
        """Return positions, velocities and goal, float32 ``[S]`` (SI units)."""
        parts = world.position, world.velocity, self.goal(world)
        return np.concatenate(parts).astype(np.float32)

    def reward(self, world: MujocoWorld) -> float:
        return world.reward

    def person_action(self, world: MujocoWorld, direction: np.ndarray) -> np.ndarray:
        """Return the action that moves along ``direction`` ``[3]`` as the first camera sees it: right, away and up."""
        azimuth = np.deg2rad(self.cameras[0].azimuth)
        away, right = (np.cos(azimuth), np.sin(azimuth)), (np.sin(azimuth), -np.cos(azimuth))
        x, y = direction[0] * np.array(right) + direction[1] * np.array(away)
        way = {"x": x, "y": y, "z": direction[2]}
        return self.action_limit * np.array([way.get(name, 0.0) for name in self.action])

    def describe(self, seed: int) -> dict[str, Any]:
        return {"seed": seed % 2**32}
