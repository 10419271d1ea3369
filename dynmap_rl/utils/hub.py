"""Ids of the Hugging Face hub and errors of its client, for datasets and runs."""

from __future__ import annotations

from pathlib import Path


def is_hub_id(name: str | Path, ours: str) -> bool:
    """Return whether a name can be an id of the Hugging Face hub (``user/name``).

    Args:
        name: id or path.
        ours: folder that the recipes write to; a path in it is no id.
    """
    parts = Path(name).parts
    return isinstance(name, str) and len(parts) == 2 and name[0] not in "./~" and parts[0] != ours


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or its type where there is no message."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
