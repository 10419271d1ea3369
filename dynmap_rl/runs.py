"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results.
The same command on the same folder resumes it. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import multiprocessing
import os
import random
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


LOCKS = {}  # of this process's folders: released when nothing refers to them


def write_json(path: Path, value) -> None:
    """Write ``value`` as :func:`write_bytes` does."""
    write_bytes(path, f"{_dump(value)}\n".encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write under a temporary name, then rename: the file is whole or as it was, and nothing else is left (but by a
    kill, whose leftovers the next write of the same file removes)."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            error.filename = str(path)
        raise


def read_json(path: Path, form=dict):
    """What a JSON file holds.

    Args:
        form: that it must have, see :func:`check_form`.

    Raises:
        ValueError: it is not valid JSON, not a file of UTF-8, or of another form; the message names the file.
    """
    try:
        value = json.loads(Path(path).read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({error}); delete it or restore it") from error
    check_form(value, form, str(path))
    return value


def check_form(value, form, where: str) -> None:
    """Refuse JSON in which something is missing, or is not what it should be.

    Args:
        form: a type; ``[form]`` for a list of such values; ``{name: form}`` for a dict that has these, and maybe others;
            ``{str: form}`` for one of any names.
        where: the value is, for the message.

    Raises:
        ValueError: the value is of another form.
    """
    kind = form if isinstance(form, type) else type(form)
    if not isinstance(value, kind):
        text = json.dumps(value)
        text = text if len(text) < 40 else f"{text[:40]} ..."
        raise ValueError(f"{where} is {text}, not of the type {kind.__name__}; restore the file or delete it")
    if isinstance(form, list):
        for number, entry in enumerate(value):
            check_form(entry, form[0], f"{where}, {number}")
    elif isinstance(form, dict):
        for name in value if str in form else form:
            check_form(value.get(name), form.get(name, form.get(str)), f"{where}, {name}")


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


def lock_folder(folder: Path) -> None:
    """Make the folder, and keep it for this process until it ends.

    Raises:
        ValueError: another process works in it.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    path = folder.resolve() / ".lock"
    try:
        LOCKS[path] = FileLock(path, timeout=0, is_singleton=True)
        LOCKS[path].acquire()
    except Timeout as error:
        raise ValueError(f"another process works in {folder}; wait for it, or stop it") from error


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


def choose_device(name: str) -> torch.device:
    """The device of a name; ``auto`` is the GPU where there is one.

    Raises:
        ValueError: there is no such device here.
    """
    import torch

    gpu = torch.cuda.is_available()
    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"--device is auto, cpu or cuda, not {name!r}")
    if name == "cuda" and not gpu:
        raise ValueError(
            "--device cuda: PyTorch finds no GPU here; leave it out, or install a CUDA build of PyTorch"
        )
    return torch.device("cuda" if gpu and name != "cpu" else "cpu")


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy and torch."""
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def run_processes(stages: Sequence[Callable[[tuple], None]], arguments: list[tuple], count: int) -> None:
    """Every stage of each argument, ``count`` at a time, each in a process of its own; one at a time, or one alone, in
    this one. A stage waits until the one before is done for this argument, and for the first stages of all.

    Raises:
        OSError: a process died.
    """
    if min(count, len(arguments)) <= 1:
        for one in arguments:
            for stage in stages:
                stage(one)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=start_worker) as pool:
        try:
            running = {pool.submit(stages[0], one): (one, stages[1:]) for one in arguments}
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    one, later = running.pop(future)
                    future.result()
                    if later:
                        running[pool.submit(later[0], one)] = one, later[1:]
        except BrokenProcessPool as error:
            raise OSError("a process died (of memory?); the same command goes on") from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def start_worker() -> None:
    """End at once and without a word on Ctrl-C, and when the parent ends, even if it is killed."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which Python would report as leaked
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _dump(value, indent: str = "") -> str:
    """JSON with an entry a line, but lists of plain values in one."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(str(k))}: {_dump(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict | list | tuple) for v in value):
        return "[\n" + ",\n".join(inner + _dump(v, inner) for v in value) + f"\n{indent}]"
    return json.dumps(value)


def _plain(value):
    """Tensors and arrays as plain numbers or lists."""
    if not hasattr(value, "tolist"):
        return value
    return value.item() if math.prod(value.shape) == 1 else value.tolist()
