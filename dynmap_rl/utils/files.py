"""Files that are whole at any moment: atomic writes, JSON whose structure is checked, locked folders."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
from pathlib import Path

LOCKS = {}  # locks of this process by path; a lock is released when nothing refers to it


def write_json(path: Path, value) -> None:
    """Write a value as JSON, atomically (see :func:`write_bytes`)."""
    write_bytes(path, f"{_dump(value)}\n".encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, then rename it.

    The file is complete or unchanged at any moment, as long as one process at a time writes it. A temporary file that a
    kill leaves behind is overwritten by the next write.
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
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
    """Read a JSON file.

    Args:
        path: file to read.
        form: structure that the value must have (see :func:`check_form`).

    Raises:
        ValueError: the file is not valid JSON in UTF-8, or the value has another structure.
    """
    try:
        value = json.loads(Path(path).read_text())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON ({error}); delete it or restore it") from error
    check_form(value, form, str(path))
    return value


def check_form(value, form, where: str) -> None:
    """Check the structure of a JSON value.

    Args:
        value: what was read.
        form: a type; ``[form]`` for a list of such values; ``{name: form}`` for a dict with at least these entries;
            ``{str: form}`` for a dict with any names.
        where: place of the value, for the message.

    Raises:
        ValueError: an entry is missing or has another type.
    """
    kind = form if isinstance(form, type) else type(form)
    if not isinstance(value, kind):
        text = json.dumps(value)
        text = text if len(text) < 40 else f"{text[:40]} ..."
        raise ValueError(
            f"{where} must be of the type {kind.__name__}, got {text}; restore the file or delete it"
        )
    if isinstance(form, list):
        for number, entry in enumerate(value):
            check_form(entry, form[0], f"{where}, {number}")
    elif isinstance(form, dict):
        for name in value if str in form else form:
            check_form(value.get(name), form.get(name, form.get(str)), f"{where}, {name}")


def check_space(folder: Path, size: int) -> None:
    """Raise ``OSError`` if ``size`` bytes do not fit: a process that maps a file into memory would be killed."""
    if (free := shutil.disk_usage(folder).free) < size:
        raise OSError(errno.ENOSPC, f"{size / 1e6:.0f} MB are needed, {free / 1e6:.0f} are free", str(folder))


def lock_folder(folder: Path) -> None:
    """Create a folder and lock it until this process ends.

    Raises:
        ValueError: another process has locked it.
    """
    from filelock import FileLock, Timeout

    folder.mkdir(parents=True, exist_ok=True)
    path = folder.resolve() / ".lock"
    try:
        LOCKS[path] = FileLock(path, timeout=0, is_singleton=True)
        LOCKS[path].acquire()
    except Timeout as error:
        raise ValueError(
            f"{folder} is in use by another process; wait for that process or stop it"
        ) from error


def _dump(value, indent: str = "") -> str:
    """Return JSON with one entry a line, and lists of plain values on a single line; NaN, which JSON lacks, as null."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(str(k))}: {_dump(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict | list | tuple) for v in value):
        return "[\n" + ",\n".join(inner + _dump(v, inner) for v in value) + f"\n{indent}]"
    if isinstance(value, list | tuple):
        return json.dumps([_finite(v) for v in value])
    return json.dumps(_finite(value), allow_nan=False)


def _finite(value):
    return None if isinstance(value, float) and not math.isfinite(value) else value
