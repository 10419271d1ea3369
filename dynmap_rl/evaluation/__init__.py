"""Closed-loop rollouts, DR / PE / SR, statistics and figures."""

from .dataset_page import write_dataset_page
from .held_out import policy_errors, write_held_out
from .html import write_html
from .imagination import open_loop_errors
from .paper import TABLES, paper_numbers, parse_supervision, row_name
from .report import SHARED_STARTS, evaluate, film_policy, print_row, write_report
from .rollout import episode_rows, failures_first, roll_out, scene_seeds
from .statistics import rate_gap, shared_interval, summarize, summarize_seeds, wilson

__all__ = [
    "SHARED_STARTS",
    "TABLES",
    "episode_rows",
    "evaluate",
    "failures_first",
    "film_policy",
    "open_loop_errors",
    "paper_numbers",
    "parse_supervision",
    "policy_errors",
    "print_row",
    "roll_out",
    "row_name",
    "scene_seeds",
    "shared_interval",
    "rate_gap",
    "summarize",
    "summarize_seeds",
    "wilson",
    "write_dataset_page",
    "write_held_out",
    "write_html",
    "write_report",
]
