"""The numbers of the paper's Table I: mean (std) over three policy seeds of DR (%), PE (mm) and SR (%)."""

from __future__ import annotations

from collections.abc import Iterable

DYNAMICS = ("position", "velocity", "acceleration")

TABLE_1 = {
    "feedforward": {
        "Only-RGB": ((55, 2.5), (69, 15.6), (21, 5.7)),
        "RGB+[P]": ((31, 8.4), (33, 2.8), (62, 9.1)),
        "RGB+[V]": ((11, 2.5), (41, 5.8), (79, 1.9)),
        "RGB+[A]": ((15, 3.4), (80, 21.2), (53, 5.7)),
        "RGB+[P+V]": ((7, 5.0), (25, 2.2), (85, 5.2)),
        "RGB+[P+A]": ((34, 4.3), (56, 4.7), (42, 8.6)),
        "RGB+[V+A]": ((9, 2.5), (31, 7.0), (80, 1.6)),
        "RGB+[P+V+A]": ((9, 5.0), (25, 1.6), (84, 7.5)),
    },
    "recurrent": {
        "Only-RGB": ((14, 1.6), (31, 1.3), (73, 3.8)),
        "RGB+[P]": ((4, 3.3), (21, 2.7), (92, 4.3)),
        "RGB+[V]": ((7, 1.9), (29, 5.0), (85, 3.8)),
        "RGB+[A]": ((5, 0.9), (36, 3.5), (79, 4.1)),
        "RGB+[P+V]": ((5, 2.5), (23, 3.7), (89, 0.9)),
        "RGB+[P+A]": ((2, 1.6), (32, 6.1), (84, 1.6)),
        "RGB+[V+A]": ((8, 4.3), (28, 7.0), (82, 7.1)),
        "RGB+[P+V+A]": ((5, 0.9), (25, 2.2), (87, 1.9)),
    },
}


def row_name(supervision: Iterable[str]) -> str:
    """The paper's name of a supervision: ``("position", "velocity")`` is ``RGB+[P+V]``, none is ``Only-RGB``."""
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
