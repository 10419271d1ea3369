"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results.
The same command on the same folder resumes it. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

from dynmap_rl.utils.files import lock_folder, read_json, write_bytes, write_json

if TYPE_CHECKING:
    pass


def open_run(folder: Path, config, *, ignore: tuple[str, ...] = ()) -> Path:
    """Create the folder, or reopen it where its settings are the same ones (but for ``ignore``); it is then this
    process's until it ends.

    Args:
        config: a dataclass of settings.

    Raises:
        ValueError: the folder holds a run with other settings, or another process works in it.
    """
    folder = Path(folder)
    lock_folder(folder)
    settings = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    path = folder / "config.json"
    if path.exists():
        stored = read_json(path)
        changed = {
            k: (stored.get(k), settings.get(k))
            for k in {*stored, *settings} - set(ignore)
            if stored.get(k) != settings.get(k)
        }
        if changed:
            detail = ", ".join(f"{k}: {old} there, {new} here" for k, (old, new) in sorted(changed.items()))
            raise ValueError(
                f"{folder} holds a run with other settings ({detail}); choose another --run, or delete it"
            )
    else:
        write_json(path, settings)
    return folder


def append_metrics(folder: Path, step: int, **metrics: float) -> None:
    """Append one line to ``metrics.jsonl``."""
    line = json.dumps({"step": step, **{k: _plain(v) for k, v in metrics.items()}})
    Path(folder).mkdir(parents=True, exist_ok=True)
    with open(Path(folder) / "metrics.jsonl", "a") as file:
        file.write(line + "\n")


def read_metrics(folder: Path) -> list[dict]:
    """The lines of ``metrics.jsonl``; a last line cut short by a kill is left out.

    Raises:
        ValueError: an earlier line is damaged.
    """
    path = Path(folder) / "metrics.jsonl"
    if not path.exists():
        return []
    rows, lines = [], path.read_text().splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError as error:
            if number < len(lines):
                raise ValueError(f"{path}, line {number} is not valid JSON ({error}); remove it") from error
    return rows


def truncate_metrics(folder: Path, step: int) -> None:
    """Drop the lines after ``step``: what a killed run wrote beyond its last training state."""
    rows = [row for row in read_metrics(folder) if row["step"] <= step]
    write_bytes(Path(folder) / "metrics.jsonl", "".join(json.dumps(row) + "\n" for row in rows).encode())


def save_training_state(path: Path, **state) -> None:
    """Save tensors and plain values, with the states of torch's generators, atomically."""
    import torch

    buffer = io.BytesIO()
    gpu = {"gpu_rng": torch.cuda.get_rng_state()} if torch.cuda.is_initialized() else {}
    torch.save({**state, **gpu, "rng": torch.get_rng_state()}, buffer)
    write_bytes(path, buffer.getbuffer())


def load_training_state(path: Path) -> dict | None:
    """What :func:`save_training_state` wrote, the generator restored; None where there is nothing yet.

    Raises:
        ValueError: the file is damaged.
    """
    import torch

    if not Path(path).exists():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        torch.set_rng_state(state.pop("rng"))
        gpu = state.pop("gpu_rng", None)
        if gpu is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state(gpu)
    except Exception as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it to train from the start") from error
    return state


def _plain(value):
    """Tensors and arrays as plain numbers or lists."""
    if not hasattr(value, "tolist"):
        return value
    return value.item() if math.prod(value.shape) == 1 else value.tolist()
