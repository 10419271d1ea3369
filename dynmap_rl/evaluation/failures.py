"""Causes of failed episodes, from their trajectories."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from tensordict import TensorDictBase

from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.envs.scene import BinRanges
from dynmap_rl.envs.task import ROCKING, Task
from dynmap_rl.envs.tasks import (
    REST_SPEED,
    SUCCESS_DISTANCE,
    BalanceReaching,
    BalanceReachingObstacle,
    BinDropping,
    get_task,
)
from dynmap_rl.envs.world import FINAL_STEPS

CAUSES = (
    "drops at the start", "drops while accelerating", "drops while braking", "drops at the goal",
    "touches the obstacle", "still moves at the end", "stops short", "overshoots", "stops beside the goal",
    "keeps the block", "drops beside the bin", "in the bin, but touched or moving",
    "loses the object", "hardly moves the object", "ends above or below the goal", "other",
)  # fmt: skip
MOVED = 0.01  # m


def failure_causes(episodes: TensorDictBase, task: str) -> list[str | None]:
    """Return the cause of each failed episode.

    A block that falls in task 1 or 2 is dropped at the start or at the goal if the cart is within 50 mm of it when the
    block begins to tip for good (more than 0.05 rad relative to the cart), and otherwise while the cart's speed grows or
    falls. In task 2, a touch before a drop is the cause. A cart that does not arrive is still moving if its mean speed in
    the last 10 steps exceeds 20 mm/s. Otherwise it stands before, behind or beside the goal, as seen from the start.

    In tasks without cart and block, the object is the first body. It is lost (it falls off the table), or stays within
    10 mm of its start. Otherwise the cause is where it is in the last frame: before, behind, beside, or above or below the
    goal, at rest or not. Custom tasks with cart and block, and those whose goal is not a point of two or three
    coordinates, have the cause "other".

    Places and speeds are those before the last action, as a step has the state before its action.

    Args:
        episodes: result ``[E, T]`` of :func:`dynmap_rl.evaluation.roll_out`.
        task: name of the task, or ``module:Class``.

    Returns:
        One of ``CAUSES``, or None for a success.
    """
    find = _choose(get_task(task))
    success = episodes["next", "is_success"][:, -1, 0].tolist()
    return [None if good else find(episode) for good, episode in zip(success, episodes, strict=True)]


def _choose(task: BaseTask) -> Callable[[TensorDictBase], str]:
    if isinstance(task, BinDropping):
        return _bin_cause
    if isinstance(task, BalanceReaching | BalanceReachingObstacle):
        return _carrying_cause
    known = not isinstance(task, Task) and task.layout.goal_size in (2, 3)
    return _moving_cause if known and len(task.layout.position) >= task.layout.goal_size else _other_cause


def _other_cause(episode: TensorDictBase) -> str:
    return "other"


def _carrying_cause(episode: TensorDictBase) -> str:
    dropped, touched = (_first(episode["next", name]) for name in ("dropped", "touched"))
    if touched is not None and (dropped is None or touched < dropped):
        return "touches the obstacle"
    return _miss_cause(episode) if dropped is None else _drop_cause(episode, dropped)


def _first(flags) -> int | None:
    """Return the first step in which a flag ``[T, 1]`` is set."""
    steps = flags.flatten().nonzero()
    return int(steps[0]) if len(steps) else None


def _drop_cause(episode: TensorDictBase, step: int) -> str:
    position, velocity, acceleration = (
        episode["dynamics", name].numpy() for name in ("position", "velocity", "acceleration")
    )
    upright = np.flatnonzero(np.abs(position[: step + 1, 5] - position[: step + 1, 2]) <= ROCKING)
    begin = int(upright[-1]) if len(upright) else 0
    place = position[begin, :2]
    if np.linalg.norm(place - episode["goal"][0].numpy()) < SUCCESS_DISTANCE:
        return "drops at the goal"
    if np.linalg.norm(place - position[0, :2]) < SUCCESS_DISTANCE:
        return "drops at the start"
    around = slice(max(begin - 1, 0), begin + 2)
    power = (velocity[around, :2] * acceleration[around, :2]).sum()
    return "drops while accelerating" if power > 0 else "drops while braking"


def _miss_cause(episode: TensorDictBase) -> str:
    position, velocity = (episode["dynamics", name][:, :2].numpy() for name in ("position", "velocity"))
    if np.linalg.norm(velocity[-FINAL_STEPS:], axis=1).mean() > REST_SPEED:
        return "still moves at the end"
    return _place(position[0], position[-FINAL_STEPS:].mean(0), episode["goal"][0].numpy())


def _place(start: np.ndarray, end: np.ndarray, goal: np.ndarray) -> str:
    """Return where ``end`` is, as seen from ``start``, each ``[2]``."""
    way, offset = goal - start, end - goal
    along = float(offset @ way) / max(float(np.linalg.norm(way)), 1e-9)
    across = max(float(offset @ offset) - along**2, 0.0) ** 0.5
    if abs(along) < across:
        return "stops beside the goal"
    return "overshoots" if along > 0 else "stops short"


def _bin_cause(episode: TensorDictBase) -> str:
    if not bool(episode["next", "dropped"][-1]):
        return "keeps the block"
    ranges = BinRanges()
    x, y = (episode["dynamics", "position"][-1, 3:5] - episode["goal"][0]).tolist()
    # The goal is in the bin's opening.
    inside = abs(x) < ranges.bin_width[1] / 2 and -ranges.bin_depth[1] < y < 0
    return "in the bin, but touched or moving" if inside else "drops beside the bin"


def _moving_cause(episode: TensorDictBase) -> str:
    if bool(episode["next", "dropped"][-1]):
        return "loses the object"
    goal = episode["goal"][0].numpy()
    place = episode["dynamics", "position"][:, : len(goal)].numpy()
    if np.linalg.norm(place - place[0], axis=1).max() < MOVED:
        return "hardly moves the object"
    offset = place[-1] - goal
    if np.linalg.norm(offset[2:]) > np.linalg.norm(offset[:2]):
        return "ends above or below the goal"
    return _place(place[0, :2], place[-1, :2], goal[:2])
