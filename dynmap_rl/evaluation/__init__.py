"""Closed-loop rollouts, DR / PE / SR with intervals, errors on held-out episodes, probes."""

from .errors import policy_errors, prediction_errors
from .open_loop import open_loop_errors
from .probing import probe
from .protocol import SHARED_STARTS, evaluate
from .rollout import episode_rows, roll_out, scene_seeds
from .statistics import rate_gap, shared_interval, summarize, summarize_seeds, wilson

__all__ = [
    "SHARED_STARTS",
    "episode_rows",
    "evaluate",
    "open_loop_errors",
    "policy_errors",
    "prediction_errors",
    "probe",
    "rate_gap",
    "roll_out",
    "scene_seeds",
    "shared_interval",
    "summarize",
    "summarize_seeds",
    "wilson",
]
