"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results.
The same command on the same folder resumes it. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


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


def _dump(value, indent: str = "") -> str:
    """JSON with an entry a line, but lists of plain values in one."""
    inner = indent + " "
    if isinstance(value, dict) and value:
        lines = [f"{inner}{json.dumps(str(k))}: {_dump(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(lines) + f"\n{indent}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, dict | list | tuple) for v in value):
        return "[\n" + ",\n".join(inner + _dump(v, inner) for v in value) + f"\n{indent}]"
    return json.dumps(value)
