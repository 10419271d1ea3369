"""Names on the Hugging Face hub, and what its client's errors say, for datasets and for runs."""

from __future__ import annotations

from pathlib import Path


def is_hub_id(name: str | Path, ours: str) -> bool:
    """Whether a name may be the id of something on the Hugging Face hub (``user/name``), and no path such as those in the
    folder ``ours``, where our recipes write to."""
    parts = Path(name).parts
    return isinstance(name, str) and len(parts) == 2 and name[0] not in "./~" and parts[0] != ours


def first_line(error: Exception) -> str:
    """Of what the error says, or its type where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
