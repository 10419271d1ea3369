"""Metrics as lines of JSON in the run folder and, on request, in a TorchRL logger."""

from __future__ import annotations

import functools
import importlib.util
import uuid
from pathlib import Path

from dynmap_rl.utils.files import write_bytes

from .folder import append_metrics

LOGGERS = "tensorboard", "wandb", "trackio"


def check_logger(name: str | None) -> None:
    """Raise ``ValueError`` for a logger that is unknown or not installed."""
    if name is None:
        return
    if name not in LOGGERS:
        raise ValueError(f"--logger must be one of {', '.join(LOGGERS)}, got {name!r}")
    if importlib.util.find_spec(name) is None:
        raise ValueError(f"--logger {name} needs its package: uv pip install -e '.[{name}]'")


def log_metrics(folder: Path, step: int, logger: str | None = None, **metrics: float) -> None:
    """Append a line to ``metrics.jsonl`` and pass the same numbers to a logger.

    TensorBoard writes to ``FOLDER/tensorboard``. W&B and Trackio name the run after its folder, in the project
    ``dynmap_rl``.

    Args:
        folder: run folder.
        step: number of updates so far.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.
        **metrics: numbers by name.
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
    if name == "wandb":  # one run for each seed of a process, and the same run after a resume
        options |= {"id": _run_id(folder), "reinit": "create_new"}
    return get_logger(name, str(folder), folder.as_posix(), **{f"{name}_kwargs": options})


def _run_id(folder: Path) -> str:
    path = folder / "wandb" / "id"
    if not path.exists():
        write_bytes(path, uuid.uuid4().hex[:8].encode())
    return path.read_text()
