"""Rates of the state-based experts, and the scenes on which their checkpoints are judged."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dynmap_rl.envs.geometry import path_is_blocked, way_from_start
from dynmap_rl.envs.protocol import BaseTask, check_action
from dynmap_rl.envs.scene import ObstacleScene, scene_seeds
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.world import World

from .statistics import wilson


def rates(task: Task, worlds: Iterable[World]) -> dict[str, float]:
    """Return the rates of ``success`` and ``drop``, the mean ``position_error`` (m) and the number of ``episodes``.

    Args:
        task: defines success.
        worlds: worlds at the end of their episodes.
    """
    worlds = list(worlds)
    return {
        "success": sum(task.is_success(world) for world in worlds) / len(worlds),
        "drop": sum(world.dropped for world in worlds) / len(worlds),
        "position_error": sum(world.position_error for world in worlds) / len(worlds),
        "episodes": len(worlds),
    }


def rates_text(row: dict) -> str:
    """Return the numbers of :func:`rates` as text, with the 95 % Wilson interval of the success rate."""
    low, high = wilson(row["success"] * row["episodes"], row["episodes"])
    error = f"position error {1000 * row['position_error']:.0f} mm"
    rate = f"success {100 * row['success']:.1f} % [{low:.1f}, {high:.1f}]   drop {100 * row['drop']:.1f} %"
    return f"{rate}   {error}   ({row['episodes']} scenes)"


def list_outcomes(task: Task, worlds: list[World]) -> dict[str, list[bool]]:
    """Return for every outcome whether each of the worlds has it at the end of its episode.

    Args:
        task: defines success. Tasks with an obstacle also have ``straight_path_blocked`` and ``way_leads_around``.
        worlds: worlds at the end of their episodes.
    """
    outcomes = {
        "success": [task.is_success(world) for world in worlds],
        "dropped": [world.dropped for world in worlds],
        "touched": [bool(world.touched) for world in worlds],
    }
    if issubclass(task.ranges.scene, ObstacleScene):
        outcomes["straight_path_blocked"] = [path_is_blocked(world.scene) for world in worlds]
        outcomes["way_leads_around"] = [len(way_from_start(world.scene)) > 2 for world in worlds]
    return outcomes


def judge_demonstrator(task: BaseTask, seeds: Iterable[int]) -> dict[str, list[bool]]:
    """Run the demonstrator of a task, without frames and noise.

    Args:
        task: task with a demonstrator.
        seeds: seeds of the scenes.

    Returns:
        ``success`` and ``dropped`` at the end of the episode of each scene.
    """
    world, outcomes = None, {"success": [], "dropped": []}
    limit, what = np.array(task.layout.action_limit), f"an action of the demonstrator of {task.name}"
    try:
        for seed in seeds:
            world = task.begin(seed, world=world)
            act = task.demonstrator(world)
            for _ in range(task.layout.steps):
                action = check_action(act(), len(limit), what)
                task.step([world], [np.clip(action, -limit, limit)])  # as recordings do
            outcomes["success"].append(task.is_success(world))
            outcomes["dropped"].append(world.dropped)
    finally:
        if world is not None:
            task.close(world)
    return outcomes


def summarize_outcomes(outcomes: dict[str, list[bool]]) -> tuple[str, dict[str, dict]]:
    """Return the rates of outcomes as text, and as a dict of JSON values.

    Args:
        outcomes: see :func:`list_outcomes`.

    Returns:
        The text, and by outcome ``rates`` (%), ``intervals`` (95 %, Wilson) and ``rows``, a digit for each scene.
    """
    rates = {name: 100 * sum(values) / len(values) for name, values in outcomes.items()}
    intervals = {name: wilson(sum(values), len(values)) for name, values in outcomes.items()}
    rows = {name: "".join("01"[bool(value)] for value in values) for name, values in outcomes.items()}
    lines = [
        f"{name.replace('_', ' '):22} {rate:5.1f} % [{intervals[name][0]:.1f}, {intervals[name][1]:.1f}]"
        for name, rate in rates.items()
    ]
    return "\n".join(lines), {"rates": rates, "intervals": intervals, "rows": rows}


def fresh_scenes(count: int) -> list[int]:
    """Return the seeds of ``count`` scenes that are neither trained on nor test scenes of the tables."""
    return scene_seeds("exploration", count, start=10_000_000)
