"""The tasks: what is drawn beside cart and block, what is rewarded, and what counts as success (paper, Sec. IV-B).

A task is :class:`BalanceReaching` or a subclass of it. A task of your own needs no place
in :data:`TASKS`: wherever a task is named, ``"your_module:YourTask"`` names the class.
"""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Sequence

import numpy as np

from .geometry import (
    Polygon,
    bin_walls,
    is_inside,
    keep_out,
    length,
    segment,
    square,
    wall_polygon,
    way_around,
)
from .scene import (
    GOAL_COLOR,
    BinRanges,
    BinScene,
    Color,
    ObstacleRanges,
    ObstacleScene,
    Point,
    Scene,
    SceneRanges,
    sample_scene,
)
from .world import ACCELERATION_LIMIT, CONTROL_DT, EPISODE_STEPS, VELOCITY_LIMIT, World

SUCCESS_DISTANCE = 0.05  # m, about 3 pixels
MARKER_SIZE = 0.04  # m
REST_SPEED = 0.02  # m/s
SPEEDS, ACCELERATIONS = VELOCITY_LIMIT.tolist(), ACCELERATION_LIMIT.tolist()
X_SPEED, Y_SPEED, SPIN = SPEEDS


class BalanceReaching:
    """Task 1: the cart carries the block to the goal, a green square, and stays there.

    Reward, in [-0.2, 1] a step: ``0.4 exp(-4 d) + 0.6 exp(-25 d)`` for a goal distance d in m, less small
    penalties on the cart's acceleration and tilt; 0 once the block is dropped.

    Success: after 120 steps the block was never dropped and the mean goal distance of the last 10 steps is under
    50 mm (paper, Sec. V-B).
    """

    name = "balance_reaching"
    description = "Carry the free-standing block to the green goal without dropping it."
    state_size = 16
    ranges = SceneRanges()
    symmetric = True  # mirrored and shifted demonstrations are demonstrations
    pushes = 6  # in a disturbed demonstration, which shows how to recover from them

    def sample_scene(self, rng: np.random.Generator, ranges: SceneRanges | None = None) -> Scene:
        """Draw a scene, from ``ranges`` of one's own or from the task's."""
        return sample_scene(rng, ranges or self.ranges)

    def make_world(self, scene: Scene) -> World:
        """The physics of a scene at its start."""
        return World(scene)

    def goal(self, world: World) -> np.ndarray:
        """What the policy is conditioned on, ``[2]``: the goal's x and y (m)."""
        return world.goal

    def state(self, world: World) -> np.ndarray:
        """The privileged observation of the experts, ``[16]`` float32, scaled by known ranges to about [-1, 1]
        and clipped to [-10, 10].

        Goal relative to the cart (2), cart pose (3) and velocity (3), block pose (3) and velocity (3) relative to
        the cart, cart width, block height.
        """
        # Plain numbers throughout: arrays of two or three take ten times as long.
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
        return clipped(values)

    def reward(self, world: World) -> float:
        """Of the step that led to the world as it is."""
        if world.dropped:
            return 0.0
        d = world.goal_distance
        return 0.4 * math.exp(-4 * d) + 0.6 * math.exp(-25 * d) - self.effort(world)

    def effort(self, world: World) -> float:
        """The penalty on acceleration and tilt of the cart."""
        return 0.02 * squared(world.acceleration, ACCELERATIONS) + 0.1 * min(abs(world.position[2]), 1.0)

    def is_over(self, world: World) -> bool:
        """Whether the episode has failed for good, before its 120 steps have passed."""
        return world.dropped

    def is_success(self, world: World) -> bool:
        """Whether the episode, as it stands, is one; asked at its end."""
        return world.steps >= EPISODE_STEPS and not world.dropped and world.position_error < SUCCESS_DISTANCE

    def markers(self, scene: Scene) -> list[tuple[Polygon, Color]]:
        """What is drawn behind cart and block: polygons in m, with their colours."""
        return [(square(scene.goal_x, scene.goal_y, MARKER_SIZE), GOAL_COLOR)]


class BalanceReachingObstacle(BalanceReaching):
    """Task 2: as task 1, around an obstacle in the centre, a vertical green segment that nothing may touch.

    Start and goal are drawn so that the rectangle around the largest cart and block is 30 mm away from the obstacle.

    Reward, in about [-1, 1] a step: task 1's, where the goal distance d (m) is the length of the shortest way around
    the obstacle (``geometry.way_around``), and 5 for each metre by which a step shortened it; -1 once the block is
    dropped or the obstacle touched.

    Success: as in task 1, and neither cart nor block ever touched the obstacle.
    """

    name = "balance_reaching_obstacle"
    description = "Carry the free-standing block around the obstacle to the green goal without dropping it."
    state_size = 20
    ranges = ObstacleRanges()
    symmetric = False  # the obstacle has its place

    def sample_scene(self, rng: np.random.Generator, ranges: SceneRanges | None = None) -> Scene:
        for _ in range(1000):
            scene = super().sample_scene(rng, ranges)
            ends = (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y)
            if not any(is_inside(point, *keep_out(scene)) for point in ends):
                return scene
        raise ValueError("scene: the ranges hold no start and goal away from the obstacle; widen them")

    def make_world(self, scene: ObstacleScene) -> World:
        return World(scene, [segment(scene)])

    def state(self, world: World) -> np.ndarray:
        """As in task 1, with the next point of the shortest way around the obstacle in the place of the goal; then
        the obstacle's middle relative to the cart (2), its length and the length of the way, ``[20]``."""
        s, (x, y) = world.scene, world.position[:2].tolist()
        way = self.way(world, (x, y))
        # A cart within the margin first leaves it by a hair's breadth; what matters is where it goes then.
        next_x, next_y = next((p for p in way if math.dist(p, (x, y)) > 0.02), way[-1])
        state = super().state(world)
        state[:2] = 2 * (next_x - x), 2 * (next_y - y)
        obstacle = 2 * (s.obstacle_x - x), 2 * (s.obstacle_y - y), 5 * (s.obstacle_length - 0.2)
        return np.concatenate([state, np.array([*obstacle, 2 * length(way)], dtype=np.float32)])

    def way(self, world: World, start: Point) -> list[Point]:
        """The shortest way around the obstacle from a point to the goal."""
        return way_around(world.scene, start, tuple(world.goal.tolist()))

    def reward(self, world: World) -> float:
        if self.is_over(world):
            return -1.0
        before, now = (world.commanded - world.action)[:2].tolist(), world.commanded[:2].tolist()
        d = length(self.way(world, tuple(now)))
        progress = length(self.way(world, tuple(before))) - d
        return 0.4 * math.exp(-4 * d) + 0.6 * math.exp(-25 * d) + 5 * progress - self.effort(world)

    def is_over(self, world: World) -> bool:
        return world.dropped or bool(world.touched)

    def is_success(self, world: World) -> bool:
        return super().is_success(world) and not world.touched

    def markers(self, scene: ObstacleScene) -> list[tuple[Polygon, Color]]:
        return [*super().markers(scene), (wall_polygon(*segment(scene)), GOAL_COLOR)]


class BinDropping(BalanceReaching):
    """Task 3: the block is tipped off the cart into a green bin.

    The goal g is the middle of the bin's opening.

    Reward: 1 in every step with the block in the bin, less small penalties on the cart's speed and tilt; -1 once it
    missed or the cart touched the bin; before that ``0.2 exp(-4 d)`` for a distance d (m) of block and goal; always
    less a small penalty on the cart's acceleration. It is shaped: the paper's has the 1 and the -1 alone.

    Success: the block, no longer carried, rests in the bin, its centre between the walls and below their top, slower
    than 20 mm/s in this step and the one before, and the cart never touched the bin.
    """

    name = "bin_dropping"
    description = "Tip the free-standing block into the green bin."
    state_size = 20
    ranges = BinRanges()
    symmetric = False  # the expert always tips the block to one side
    pushes = 3

    def make_world(self, scene: BinScene) -> World:
        return World(scene, bin_walls(scene))

    def state(self, world: World) -> np.ndarray:
        """As in task 1, then the goal relative to the block (2), the bin's width and its depth, ``[20]``."""
        s = world.scene
        x, y = (world.goal - world.position[3:5]).tolist()
        values = 2 * x, 2 * y, 20 * (s.bin_width - 0.28), 20 * (s.bin_depth - 0.12)
        return np.concatenate([super().state(world), clipped(values)])

    def reward(self, world: World) -> float:
        if self.is_over(world):
            return -1.0
        effort = squared(world.acceleration, ACCELERATIONS)
        if self.is_in_bin(world):
            motion = squared(world.velocity, SPEEDS)
            return 1.0 - 0.02 * effort - 0.1 * motion - 0.2 * min(abs(world.position[2]), 1.0)
        return 0.2 * math.exp(-4 * math.dist(world.position[3:5], world.goal)) - 0.02 * effort

    def is_in_bin(self, world: World) -> bool:
        """Whether the block's centre is between the walls and below their top."""
        s, (x, y) = world.scene, world.position[3:5].tolist()
        return abs(x - s.goal_x) < s.bin_width / 2 and s.goal_y - s.bin_depth < y < s.goal_y

    def is_over(self, world: World) -> bool:
        missed = world.position[4] < world.scene.goal_y - world.scene.bin_depth
        return bool(missed) or "cart" in world.touched

    def is_success(self, world: World) -> bool:
        now = world.velocity[3:5]
        before = now - world.acceleration[3:5] * CONTROL_DT
        rests = max(np.linalg.norm(now), np.linalg.norm(before)) < REST_SPEED
        tipped = world.dropped and "cart" not in world.touched
        return bool(rests) and tipped and self.is_in_bin(world)

    def markers(self, scene: BinScene) -> list[tuple[Polygon, Color]]:
        return [(wall_polygon(*wall), GOAL_COLOR) for wall in bin_walls(scene)]


def clipped(values: Sequence[float]) -> np.ndarray:
    """As float32, each within [-10, 10]."""
    array = np.array(values, dtype=np.float32)
    return np.minimum(np.maximum(array, -10.0, out=array), 10.0, out=array)  # half the time of np.clip


def squared(dynamics: np.ndarray, limits: Sequence[float]) -> float:
    """The sum of squares of the cart's three entries, in units of their limits."""
    (x, y, turn), (x_limit, y_limit, turn_limit) = dynamics[:3].tolist(), limits
    return (x / x_limit) ** 2 + (y / y_limit) ** 2 + (turn / turn_limit) ** 2


TASKS = {task.name: task for task in (BalanceReaching(), BalanceReachingObstacle(), BinDropping())}


NO_TASK = "none"  # what --task names where a dataset is of no task of ours


def get_task(name: str, from_file: bool = False) -> BalanceReaching:
    """The task of a name, or of a subclass of :class:`BalanceReaching` that is named as ``"module:Class"``.

    Args:
        from_file: a file names it, and files run no code: its module must have been imported already.

    Raises:
        ValueError: there is no such task; the message lists the known ones.
    """
    if ":" not in name:
        if name not in TASKS:
            known = f"choose from {sorted(TASKS)}, or name a class as module:Class"
            raise ValueError(f"unknown task {name!r}; {known}")
        return TASKS[name]
    module, attribute = name.split(":", 1)
    if not module or module.startswith("."):
        raise ValueError(f"there is no task {name!r}; name a class as module:Class")
    if from_file and module not in sys.modules:
        raise ValueError(
            f"a file names the task {name}, but does not get to import it; do so with --task {name}"
        )
    try:
        task = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"there is no task {name!r} ({error})") from error
    if not (isinstance(task, type) and issubclass(task, BalanceReaching)):
        raise ValueError(f"{name!r} is no task: it is no subclass of dynmap_rl.envs.tasks.BalanceReaching")
    return task()
