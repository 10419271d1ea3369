"""Metrics: always as lines of JSON in the run folder, and by TorchRL's loggers where a user wants to watch them."""

from __future__ import annotations

import functools
import importlib.util
import uuid
from pathlib import Path

from .folder import append_metrics
from dynmap_rl.utils.files import write_bytes

LOGGERS = "tensorboard", "wandb", "trackio"


def check_logger(name: str | None) -> None:
    """Raises ``ValueError`` for an unknown logger, or one that is not installed."""
    if name is None:
        return
    if name not in LOGGERS:
        raise ValueError(f"--logger is one of {', '.join(LOGGERS)}, not {name!r}")
    if importlib.util.find_spec(name) is None:
        raise ValueError(f"--logger {name} needs its package: pip install '.[{name}]'")


def log_metrics(folder: Path, step: int, logger: str | None = None, **metrics: float) -> None:
    """Append a line to ``metrics.jsonl`` and, with a logger, give it the same numbers.

    TensorBoard's files are in ``FOLDER/tensorboard``; W&B and Trackio call the run by its folder, in the project
    ``dynmap_rl``.
    """
    append_metrics(folder, step, **metrics)
    if logger:
        for name, value in metrics.items():
            _open(logger, Path(folder)).log_scalar(name, float(value), step=step)


@functools.cache
def _open(name: str, folder: Path):
    from torchrl.record.loggers import get_logger

    if name == "tensorboard":
        return get_logger(name, str(folder), "tensorboard")
    options = {"project": "dynmap_rl"}
    if name == "wandb":  # a run for each of a process's seeds, and the same one when it goes on
        options |= {"id": _run_id(folder), "reinit": "create_new"}
    return get_logger(name, str(folder), folder.as_posix(), **{f"{name}_kwargs": options})


def _run_id(folder: Path) -> str:
    path = folder / "wandb" / "id"
    if not path.exists():
        write_bytes(path, uuid.uuid4().hex[:8].encode())
    return path.read_text()
