"""The paper's Tables I, II and III: mean (std) over three policy seeds of DR (%), PE (mm) and SR (%)."""

from __future__ import annotations

from collections.abc import Iterable

from dynmap_rl.keys import DYNAMICS


def row_name(supervision: Iterable[str], training: str = "decoupled") -> str:
    """The paper's name of a row: ``("position", "velocity")`` is ``RGB+[P+V]``, none is ``Only-RGB``."""
    if training == "end_to_end":
        return "End-to-End"
    letters = [q[0].upper() for q in DYNAMICS if q in supervision]
    return f"RGB+[{'+'.join(letters)}]" if letters else "Only-RGB"


def parse_supervision(text: str) -> tuple[str, ...]:
    """``"position,velocity"`` to a tuple in the paper's order; ``"none"`` to ``()``.

    Raises:
        ValueError: for an unknown quantity.
    """
    names = [] if text.strip().lower() in ("", "none") else [name.strip() for name in text.split(",")]
    unknown = set(names) - set(DYNAMICS)
    if unknown:
        raise ValueError(f"unknown supervision {sorted(unknown)}; choose from {', '.join(DYNAMICS)}, or none")
    return tuple(q for q in DYNAMICS if q in names)
