"""Names of supervisions, as options and as rows of the paper's tables."""

from __future__ import annotations

from collections.abc import Iterable

from dynmap_rl.keys import DYNAMICS


def row_name(supervision: Iterable[str], training: str = "decoupled") -> str:
    """Return the name of a row in the paper's tables.

    Args:
        supervision: quantities; ``("position", "velocity")`` is ``RGB+[P+V]``, and none is ``Only-RGB``.
        training: ``end_to_end`` is ``End-to-End`` with any supervision.
    """
    if training == "end_to_end":
        return "End-to-End"
    letters = [q[0].upper() for q in DYNAMICS if q in supervision]
    return f"RGB+[{'+'.join(letters)}]" if letters else "Only-RGB"


def parse_supervision(text: str) -> tuple[str, ...]:
    """Parse ``"position,velocity"`` to a tuple in the paper's order, and ``"none"`` to ``()``.

    Raises:
        ValueError: a quantity is unknown.
    """
    names = [] if text.strip().lower() in ("", "none") else [name.strip() for name in text.split(",")]
    if unknown := set(names) - set(DYNAMICS):
        raise ValueError(f"supervision must be any of {', '.join(DYNAMICS)}, or none, got {sorted(unknown)}")
    return tuple(q for q in DYNAMICS if q in names)
