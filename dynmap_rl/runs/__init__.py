"""Run folders: settings, metrics, training state, and how a run is found again."""

from .folder import append_metrics, load_training_state, open_run, read_metrics, save_training_state
from .lookup import find_run, load_actor, load_source, task_of_run

__all__ = [
    "append_metrics",
    "find_run",
    "load_actor",
    "load_source",
    "load_training_state",
    "open_run",
    "read_metrics",
    "save_training_state",
    "task_of_run",
]
