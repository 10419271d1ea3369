"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results. The
same command on the same folder resumes the run. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
from pathlib import Path

from dynmap_rl.utils.files import lock_folder, read_json, write_bytes, write_json
from dynmap_rl.utils.ranks import first_rank_first, rank
from dynmap_rl.utils.settings import flatten

FORMAT = 2  # of config.json; the first release had flat settings
INPUTS = {"dataset.json", "world_model.json"}  # hashes of what a run has begun with
# Files of a run that has failed before its training.
UNTRAINED = {"config.json"} | INPUTS


def open_run(folder: Path, config, *, ignore: tuple[str, ...] = ()) -> Path:
    """Create a run folder, or reopen it for the same settings, and lock it until this process ends.

    A run that has not begun to train may get other settings.

    Of several processes that train together, the first creates and locks it.

    Args:
        folder: run folder.
        config: dataclass of settings, all with defaults, which a run has that is older than a setting.
        ignore: names of settings that may differ from those of the folder, such as ``run`` or ``ppo.iterations``.

    Returns:
        The folder.

    Raises:
        ValueError: the folder holds something else than a run, a run with other settings or of another release, or is
            in use.
    """
    with first_rank_first():
        return _open(Path(folder), config, ignore)


def _open(folder: Path, config, ignore: tuple[str, ...]) -> Path:
    path = folder / "config.json"
    if not rank():
        if folder.exists() and not path.exists() and _names(folder) - UNTRAINED:
            raise ValueError(
                f"{folder} must be a run or a new folder, got something else; choose another --run"
            )
        lock_folder(folder)
    settings = {"format": FORMAT, **plain_settings(config)}
    untrained = _names(folder) <= UNTRAINED
    begun = path.exists()
    if not begun or (untrained and not rank()):
        for name in INPUTS if begun else ():  # in a folder without config.json, they are somebody else's
            (folder / name).unlink(missing_ok=True)
        write_json(path, settings)
        return folder
    stored = read_json(path)
    if stored.get("format") != FORMAT:
        raise ValueError(
            f"{folder} holds a run of another release, which cannot resume here; choose another --run"
        )
    given = {*ignore, "format"}
    differ = compare_settings(stored, config).items()
    if changed := {k: v for k, v in differ if not {k, k.partition(".")[0]} & given}:
        detail = ", ".join(f"{name}: {old} there, {new} here" for name, (old, new) in changed.items())
        raise ValueError(
            f"{folder} holds a run with other settings ({detail}); choose another --run, or delete the folder"
        )
    return folder


def _names(folder: Path) -> set[str]:
    """Return what a folder holds, without hidden files such as a lock or those of a file manager."""
    return {file.name for file in folder.iterdir() if not file.name.startswith(".")}


def compare_settings(stored: dict, config) -> dict[str, tuple]:
    """Return the settings that differ, by dotted names, each with its stored and its new value.

    Args:
        stored: settings of :func:`plain_settings`; those that are younger than the run have their defaults.
        config: dataclass of settings, all with defaults.
    """
    new = flatten(plain_settings(config))
    old = flatten(plain_settings(type(config)())) | flatten(stored)
    pairs = {k: (old.get(k), new.get(k)) for k in sorted({*old, *new})}
    return {k: pair for k, pair in pairs.items() if _bare(pair[0]) != _bare(pair[1])}


def plain_settings(config) -> dict:
    """Return a dataclass of settings as a nested dict of JSON values."""
    return json.loads(json.dumps(dataclasses.asdict(config), default=str))


def append_metrics(folder: Path, step: int, **metrics: float) -> None:
    """Append one line to ``metrics.jsonl``, without metrics that are NaN or infinite, which JSON lacks."""
    numbers = {name: _to_number(value) for name, value in metrics.items()}
    known = {
        k: number for k, number in numbers.items() if not isinstance(number, float) or math.isfinite(number)
    }
    line = json.dumps({"step": step, **known})
    Path(folder).mkdir(parents=True, exist_ok=True)
    with open(Path(folder) / "metrics.jsonl", "a") as file:
        file.write(line + "\n")


def read_metrics(folder: Path) -> list[dict]:
    """Read the lines of ``metrics.jsonl``, except for a last line that a kill has cut short.

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
    """Drop the lines after ``step``, which a killed run wrote after its last training state."""
    if not (Path(folder) / "metrics.jsonl").exists():  # an empty one would count as begun
        return
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
    """Load what :func:`save_training_state` wrote and restore the generators; None where there is no file yet.

    Raises:
        ValueError: the file is damaged.
        OSError: the file cannot be opened.
    """
    import torch

    if not Path(path).exists():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        torch.set_rng_state(state.pop("rng"))
    except (OSError, MemoryError):
        raise
    except Exception as error:
        raise ValueError(f"{path} cannot be read ({error}); delete it to train from the start") from error
    gpu = state.pop("gpu_rng", None)
    if gpu is not None and torch.cuda.is_initialized():
        torch.cuda.set_rng_state(gpu)
    return state


def _bare(value):
    """Return a path, or any other value, without the slash at the end."""
    return value.rstrip("/") if isinstance(value, str) else value


def _to_number(value):
    """Convert tensors and arrays to plain numbers or lists."""
    if not hasattr(value, "tolist"):
        return value
    return value.item() if math.prod(value.shape) == 1 else value.tolist()
