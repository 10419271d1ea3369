"""The three tasks of the paper (Sec. IV-B), and the look-up of tasks by name."""

from __future__ import annotations

import ast
import importlib
import inspect
import math
import re
import sys

import numpy as np

from dynmap_rl.utils.graphics import check_mujoco_gl

from .geometry import (
    Polygon,
    bin_walls,
    is_inside,
    keep_out,
    length,
    segment,
    wall_polygon,
    way_around,
)
from .protocol import BaseTask
from .scene import (
    GOAL_COLOR,
    BinRanges,
    BinScene,
    Color,
    ObstacleRanges,
    ObstacleScene,
    Point,
    SceneRanges,
)
from .task import (
    ACCELERATIONS,
    SPEEDS,
    Task,
    base_state,
    clip_state,
    distance_reward,
    effort,
    goal_marker,
    squared_share,
)
from .world import CONTROL_DT, EPISODE_STEPS, World

SUCCESS_DISTANCE = 0.05  # m, about 3 pixels
REST_SPEED = 0.02  # m/s
FAILURE = -20.0  # reward of a failure; less, and PPO's experts trade drops for speed


def has_arrived(world: World) -> bool:
    """Return whether the episode's 120 steps ended at the goal: never dropped, position error under 50 mm."""
    return world.steps >= EPISODE_STEPS and not world.dropped and world.position_error < SUCCESS_DISTANCE


class BalanceReaching(Task):
    """Task 1: carry the block to the goal, a green square, and stay there.

    State: ``[16]``, see :func:`dynmap_rl.envs.task.base_state`.

    Reward, -0.8 to 1 a step: ``0.4 exp(-4 d) + 0.6 exp(-25 d)`` for a goal distance d (m), minus small penalties on
    acceleration and tilt of the cart and on a rocking block; -20 once the block is dropped.

    End: the block is dropped.

    Success: after 120 steps the block was never dropped, and the mean goal distance of the last 10 steps is under
    50 mm (paper, Sec. V-B).
    """

    name = "balance_reaching"
    description = "Carry the free-standing block to the green goal without dropping it."
    symmetric = True

    def reward(self, world: World) -> float:
        if world.dropped:
            return FAILURE
        return distance_reward(world.goal_distance) - effort(world)

    def is_success(self, world: World) -> bool:
        return has_arrived(world)


class BalanceReachingObstacle(Task):
    """Task 2: carry the block around an obstacle in the centre, a vertical green segment that nothing may touch.

    Starts and goals keep the rectangle around the largest cart and block 30 mm away from the obstacle.

    State: ``[20]``, the 16 entries of task 1, where the next point of the shortest way around the obstacle takes the
    place of the goal; then the middle of the obstacle relative to the cart (2), its length, and the length of the way.

    Reward, about -1 to 1.3 a step: that of task 1, where the goal distance d (m) is the length of the shortest way
    around the obstacle, plus 5 for each metre by which the step shortened the way; -20 once the block is dropped or the
    obstacle touched.

    End: the block is dropped, or cart or block touched the obstacle.

    Success: as in task 1, and neither cart nor block ever touched the obstacle.
    """

    name = "balance_reaching_obstacle"
    description = "Carry the free-standing block around the obstacle to the green goal without dropping it."
    state_size = 20
    ranges = ObstacleRanges()

    def sample_scene(self, rng: np.random.Generator, ranges: SceneRanges | None = None) -> ObstacleScene:
        for _ in range(1000):
            scene = super().sample_scene(rng, ranges)
            ends = (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y)
            if not any(is_inside(point, *keep_out(scene)) for point in ends):
                return scene
        raise ValueError("the ranges must hold a start and a goal away from the obstacle; widen them")

    def make_world(self, scene: ObstacleScene) -> World:
        return World(scene, [segment(scene)])

    def state(self, world: World) -> np.ndarray:
        s, (x, y) = world.scene, world.position[:2].tolist()
        way = self.way(world, (x, y))
        # Skip a first point that is hardly away, as of a cart just within the margin.
        next_x, next_y = next((p for p in way if math.dist(p, (x, y)) > 0.02), way[-1])
        state = base_state(world)
        state[:2] = 2 * (next_x - x), 2 * (next_y - y)
        obstacle = 2 * (s.obstacle_x - x), 2 * (s.obstacle_y - y), 5 * (s.obstacle_length - 0.2)
        return np.concatenate([state, np.array([*obstacle, 2 * length(way)], dtype=np.float32)])

    def way(self, world: World, start: Point) -> list[Point]:
        """Return the points of the shortest way around the obstacle, from ``start`` to the goal (m)."""
        return way_around(world.scene, start, tuple(world.goal.tolist()))

    def reward(self, world: World) -> float:
        if self.is_over(world):
            return FAILURE
        before, now = (world.commanded - world.action)[:2].tolist(), world.commanded[:2].tolist()
        distance = length(self.way(world, tuple(now)))
        progress = length(self.way(world, tuple(before))) - distance
        return distance_reward(distance) + 5 * progress - effort(world)

    def is_over(self, world: World) -> bool:
        return world.dropped or bool(world.touched)

    def is_success(self, world: World) -> bool:
        return has_arrived(world) and not world.touched

    def markers(self, scene: ObstacleScene) -> list[tuple[Polygon, Color]]:
        return [goal_marker(scene), (wall_polygon(*segment(scene)), GOAL_COLOR)]


class BinDropping(Task):
    """Task 3: tip the block off the cart into a green bin.

    The goal is the middle of the bin's opening.

    State: ``[20]``, the 16 entries of task 1, then the goal relative to the block (2), width and depth of the bin.

    Reward, -5 to 1 a step: with the block in the bin 1, minus small penalties on the cart's speed and tilt; before
    that ``0.2 exp(-4 d)`` for a distance d (m) from block to goal; in both cases minus a small penalty on the cart's
    acceleration; -5 once the block missed the bin or the cart touched it.

    End: the block fell below the bin's floor beside it, or the cart touched the bin.

    Success: the block, no longer carried, rests in the bin, that is, its centre is between the walls and below their
    top, and its speed was below 20 mm/s in the last two steps; and the cart never touched the bin.
    """

    name = "bin_dropping"
    description = "Tip the free-standing block into the green bin."
    state_size = 20
    ranges = BinRanges()
    pushes = 3

    def make_world(self, scene: BinScene) -> World:
        return World(scene, bin_walls(scene))

    def state(self, world: World) -> np.ndarray:
        s = world.scene
        x, y = (world.goal - world.position[3:5]).tolist()
        values = 2 * x, 2 * y, 20 * (s.bin_width - 0.28), 20 * (s.bin_depth - 0.12)
        return np.concatenate([base_state(world), clip_state(values)])

    def reward(self, world: World) -> float:
        if self.is_over(world):
            return FAILURE / 4
        acceleration = squared_share(world.acceleration, ACCELERATIONS)
        if self.is_in_bin(world):
            motion = squared_share(world.velocity, SPEEDS)
            return 1.0 - 0.02 * acceleration - 0.1 * motion - 0.2 * min(abs(world.position[2]), 1.0)
        return 0.2 * math.exp(-4 * math.dist(world.position[3:5], world.goal)) - 0.02 * acceleration

    def is_in_bin(self, world: World) -> bool:
        """Return whether the block's centre is between the walls and below their top."""
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


TASKS = {task.name: task for task in (BalanceReaching(), BalanceReachingObstacle(), BinDropping())}
MUJOCO = "mujoco"  # short name of the module of the MuJoCo tasks
MUJOCO_MODULE = "dynmap_rl.envs.mujoco"


def get_task(name: str, from_file: bool = False, kind: type[BaseTask] = BaseTask) -> BaseTask:
    """Return the task of a name, or an instance of the class that is named ``"module:Class"``.

    ``"mujoco:FetchSlide"`` names a class of :mod:`dynmap_rl.envs.mujoco`. Arguments of a class follow after another
    colon: ``"mujoco:FetchSlide:image_size=96,cameras=2"``.

    Args:
        name: name of a task.
        from_file: whether the name comes from a file. A file must not run code, so the module must have been imported
            before.
        kind: class that the task must be an instance of.

    Raises:
        ValueError: there is no task of this name, or the class is not a complete subclass of ``kind``, or its arguments
            are wrong.
        OSError: the renderer that ``MUJOCO_GL`` names cannot be loaded.
    """
    task = TASKS.get(name) or _make_task(name, from_file)
    if not isinstance(task, kind):
        raise ValueError(
            f"{name} must be a task of cart and block here, a subclass of dynmap_rl.envs.{kind.__name__}"
        )
    return task


def _make_task(name: str, from_file: bool) -> BaseTask:
    """Make an instance of the class that is named ``"module:Class"`` or ``"module:Class:argument=value,..."``."""
    if ":" not in name:
        raise ValueError(f"the task must be one of {sorted(TASKS)} or module:Class, got {name!r}")
    module, attribute, *rest = name.split(":", 2)
    if not module or module.startswith("."):
        raise ValueError(f"the task must be named as module:Class, got {name!r}")
    own = module == MUJOCO
    if from_file and not own and module not in sys.modules:
        raise ValueError(f"the task {name!r} of a file must be imported first; name it with --task {name}")
    try:
        task = getattr(importlib.import_module(MUJOCO_MODULE if own else module), attribute)
    except (ImportError, AttributeError) as error:
        check_mujoco_gl()
        hint = ""
        if own and isinstance(error, ImportError):
            hint = "; MuJoCo tasks need uv pip install -e '.[mujoco]'"
        elif getattr(error, "name", None) == module:
            hint = f"; run where {module} can be imported, such as in its folder"
        raise ValueError(
            f"the task must be module:Class or module:Class:argument=value, got {name!r} ({error}){hint}"
        ) from error
    if not (isinstance(task, type) and issubclass(task, BaseTask)):
        raise ValueError(f"{name!r} must be a subclass of dynmap_rl.envs.Task or BaseTask, got {task!r}")
    if missing := sorted(task.__abstractmethods__):
        raise ValueError(f"the task {name!r} must define {', '.join(missing)}")
    try:
        made = task(**(_parse_arguments(rest[0]) if rest else {}))
    except (TypeError, ValueError) as error:
        what = f"the arguments of the task {name!r} are" if rest else f"the task {name!r} is"
        known = ", ".join(inspect.signature(task).parameters) or "none"
        raise ValueError(f"{what} wrong ({error}); it takes {known}") from error
    if rest:
        try:
            made.name = re.sub("[^a-z0-9]+", "_", f"{made.name}_{rest[0].lower()}")
        except AttributeError as error:
            raise ValueError(
                f"name of the task {name!r} must be a class attribute, got a property"
            ) from error
    return made


def _parse_arguments(text: str) -> dict[str, object]:
    """Parse ``"image_size=96,arm=True"``; a value that is no literal of Python is a text."""
    pairs = [part.partition("=")[::2] for part in text.split(",")]
    values = {name.strip(): _parse_value(value.strip()) for name, value in pairs}
    if "" in values or len(values) < len(pairs):
        raise ValueError(f"they must have different names, got {text!r}")
    return values


def _parse_value(text: str) -> object:
    if text in ("true", "false"):  # as recipes write them
        return text == "true"
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text
