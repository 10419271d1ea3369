"""Base class of tasks, and the pieces that tasks share: state, rewards, marker."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from .geometry import Polygon, square
from .protocol import BaseTask, Layout
from .scene import GOAL_COLOR, Color, Scene, SceneRanges, sample_scene
from .world import (
    ACCELERATION_LIMIT,
    ACTION_LIMIT,
    CONTROL_DT,
    EPISODE_STEPS,
    VELOCITY_LIMIT,
    World,
    step_worlds,
)

MARKER_SIZE = 0.04  # m
ROCKING = 0.05  # rad, tilt of a block on the cart from which on the penalty is full
SPEEDS, ACCELERATIONS = VELOCITY_LIMIT.tolist(), ACCELERATION_LIMIT.tolist()
X_SPEED, Y_SPEED, SPIN = SPEEDS

POSE = "cart_x", "cart_y", "cart_theta"
BODIES = (*POSE, "block_x", "block_y", "block_theta")
LAYOUT = Layout(
    steps=EPISODE_STEPS,
    fps=round(1 / CONTROL_DT),
    action=("delta_x", "delta_y", "delta_theta"),
    action_limit=tuple(ACTION_LIMIT.tolist()),
    state=(*POSE, "goal_x", "goal_y"),
    position=BODIES,
    velocity=BODIES,
)


class Task(BaseTask):
    """Task of a cart and a block: scenes, goal, reward, end and success of an episode, and the markers that are drawn.

    A subclass must define ``name``, ``description``, ``reward`` and ``is_success``. Everything else has a default: a
    scene of cart, block and goal without walls, an episode that ends early when the block is dropped, and a green
    square at the goal. ``"your_module:YourTask"`` names the class wherever a task is named.

    A task has no state: one instance serves many worlds, and every method depends on its arguments alone. Methods
    that take a world leave it unchanged and can be called at any time, also after the end of the episode.

    Attributes:
        name: lower case with underscores; folders and datasets are named after it.
        description: instruction in one sentence; datasets store it as LeRobot's ``task``.
        ranges: ranges from which scenes are drawn. ``ranges.scene`` is the class of these scenes. A subclass of
            ``Scene`` with a subclass of ``SceneRanges`` adds factors of its own.
        state_size: number of entries S of ``state``.
        symmetric: whether a demonstration that is mirrored left to right, or shifted, is a demonstration of the
            task. Joint and end-to-end training then mirror and shift windows, which their policies learn from.
        pushes: number of pushes in a disturbed demonstration, which shows how to recover from them.
    """

    ranges: SceneRanges = SceneRanges()
    layout: Layout = LAYOUT
    state_size: int = 16
    planar: bool = True
    pushes: int = 6

    @abstractmethod
    def reward(self, world: World) -> float:
        """Return the reward of the last step, about -1 to 1."""

    @abstractmethod
    def is_success(self, world: World) -> bool:
        """Return whether the episode would be a success if it ended with the last step."""

    def sample_scene(self, rng: np.random.Generator, ranges: SceneRanges | None = None) -> Scene:
        """Draw a scene from ``ranges``, by default from the task's own."""
        return sample_scene(rng, ranges or self.ranges)

    def make_world(self, scene: Scene) -> World:
        """Make the world of a scene at its start, with the walls of the task."""
        return World(scene)

    def begin(self, seed: int, ranges: SceneRanges | None = None, world: World | None = None) -> World:
        """Make the world of the scene that ``seed`` determines."""
        return self.make_world(self.sample_scene(np.random.default_rng(seed), ranges))

    def step(self, worlds: Sequence[World], actions: Sequence[np.ndarray]) -> None:
        """Simulate one control step of every world with its position-update action ``[3]``."""
        step_worlds(worlds, actions)

    def make_renderer(self) -> Callable[[World], np.ndarray]:
        """Return the function that draws a world, uint8 ``[64, 64, 3]``."""
        from .renderer import Renderer  # loads pygame, which reading a dataset does not need

        return partial(Renderer(self.layout.image_size).draw, task=self)

    def describe(self, seed: int) -> dict:
        """Return all factors of the scene of a seed."""
        return self.sample_scene(np.random.default_rng(seed)).to_dict()

    def agent_pos(self, world: World) -> np.ndarray:
        """Return commanded cart pose and goal, ``[5]`` (m, m, rad, m, m)."""
        return np.concatenate([world.commanded, self.goal(world)])

    def goal(self, world: World) -> np.ndarray:
        """Return the goal on which policies are conditioned, ``[2]``: x and y (m)."""
        return world.goal

    def state(self, world: World) -> np.ndarray:
        """Return the privileged observation for experts, float32 ``[S]`` within [-10, 10]; see :func:`base_state`."""
        return base_state(world)

    def is_over(self, world: World) -> bool:
        """Return whether the episode has failed for good, before its 120 steps have passed."""
        return world.dropped

    def markers(self, scene: Scene) -> list[tuple[Polygon, Color]]:
        """Return the polygons (m) that are drawn behind cart and block, with their colours."""
        return [goal_marker(scene)]


def base_state(world: World) -> np.ndarray:
    """Return the state of cart, block and goal, float32 ``[16]``, scaled to about [-1, 1], clipped to [-10, 10].

    Goal relative to the cart (2), cart pose (3) and velocity (3), block pose (3) and velocity (3) relative to the
    cart, cart width, block height.
    """
    # Plain numbers throughout: arrays of two or three entries take ten times as long.
    s, (goal_x, goal_y) = world.scene, world.goal.tolist()
    x, y, tilt = world.block_in_cart
    cart_x, cart_y, theta = world.position[:3].tolist()
    vx, vy, spin, block_vx, block_vy, block_spin = world.velocity.tolist()
    values = (
        2 * (goal_x - cart_x),
        2 * (goal_y - cart_y),
        2 * (cart_x - 0.5),
        2 * (cart_y - 0.5),
        2 * theta,
        vx / X_SPEED,
        vy / Y_SPEED,
        spin / SPIN,
        10 * x,
        10 * (y - (s.cart_height + s.block_height) / 2),
        2 * tilt,
        5 * (block_vx - vx),
        5 * (block_vy - vy),
        block_spin - spin,
        20 * (s.cart_width - 0.25),
        20 * (s.block_height - 0.16),
    )
    return clip_state(values)


def clip_state(values: Sequence[float]) -> np.ndarray:
    """Return the values as float32, each clipped to [-10, 10]."""
    array = np.array(values, dtype=np.float32)
    return np.minimum(np.maximum(array, -10.0, out=array), 10.0, out=array)  # half the time of np.clip


def distance_reward(distance: float) -> float:
    """Return the reward of a goal distance (m): 1 at the goal, falling towards 0."""
    return 0.4 * math.exp(-4 * distance) + 0.6 * math.exp(-25 * distance)


def effort(world: World) -> float:
    """Return the penalty on acceleration and tilt of the cart and on a rocking block, 0 to 0.78."""
    rocking = min(abs(world.block_in_cart[2]) / ROCKING, 1.0)
    share = squared_share(world.acceleration, ACCELERATIONS)
    return 0.06 * share + 0.1 * min(abs(world.position[2]), 1.0) + 0.5 * rocking


def squared_share(dynamics: np.ndarray, limits: Sequence[float]) -> float:
    """Return the sum of squares of the cart's three entries of ``dynamics`` ``[6]``, each in units of its limit."""
    (x, y, turn), (x_limit, y_limit, turn_limit) = dynamics[:3].tolist(), limits
    return (x / x_limit) ** 2 + (y / y_limit) ** 2 + (turn / turn_limit) ** 2


def goal_marker(scene: Scene) -> tuple[Polygon, Color]:
    """Return the green square around the goal, and its colour."""
    return square(scene.goal_x, scene.goal_y, MARKER_SIZE), GOAL_COLOR
