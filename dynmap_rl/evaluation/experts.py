"""Rates of the state-based experts, and the scenes on which their checkpoints are judged."""

from __future__ import annotations

from collections.abc import Iterable

from dynmap_rl.envs.scene import scene_seed
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


def fresh_scenes(count: int) -> list[int]:
    """Return the seeds of ``count`` scenes that are neither trained on nor test scenes of the tables."""
    return [scene_seed("exploration", 10_000_000 + i) for i in range(count)]
