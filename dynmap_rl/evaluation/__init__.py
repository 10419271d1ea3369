"""Closed-loop rollouts, DR / PE / SR, statistics and figures."""

from .rollout import PAPER_EPISODES, TEST_EPISODES, episode_rows, roll_out, scene_seeds
from .statistics import success_gap, summarize, summarize_seeds, wilson

__all__ = [
    "PAPER_EPISODES",
    "TEST_EPISODES",
    "episode_rows",
    "roll_out",
    "scene_seeds",
    "success_gap",
    "summarize",
    "summarize_seeds",
    "wilson",
]
