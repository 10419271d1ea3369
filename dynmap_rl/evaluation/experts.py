"""PPO, from states for the experts (paper, Sec. IV-C) and from whatever else an environment's ``state`` holds."""

from __future__ import annotations

from collections.abc import Iterable

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import BalanceReaching
from dynmap_rl.envs.world import World
from .statistics import wilson


def rates(task: BalanceReaching, worlds: Iterable[World]) -> dict[str, float]:
    """``success``, ``drop``, ``position_error`` (m) and number of ``episodes`` of worlds at their ends."""
    worlds = list(worlds)
    return {
        "success": sum(task.is_success(world) for world in worlds) / len(worlds),
        "drop": sum(world.dropped for world in worlds) / len(worlds),
        "position_error": sum(world.position_error for world in worlds) / len(worlds),
        "episodes": len(worlds),
    }


def rates_text(row: dict) -> str:
    """What :func:`rates` gave as text, with the 95 % Wilson interval of the success rate."""
    low, high = wilson(row["success"] * row["episodes"], row["episodes"])
    error = f"position error {1000 * row['position_error']:.0f} mm"
    rate = f"success {100 * row['success']:.1f} % [{low:.1f}, {high:.1f}]   drop {100 * row['drop']:.1f} %"
    return f"{rate}   {error}   ({row['episodes']} scenes)"


def fresh_scenes(count: int) -> list[int]:
    """Seeds of the scenes that checkpoints are judged on, the last by more of them: of the exploration split, never trained
    on, and none of the tables' test scenes."""
    return [scene_seed("exploration", 10_000_000 + i) for i in range(count)]
