"""Which of the paper's claims hold here: pairs of cells, compared on the start states that both share (Sec. V)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.stats import false_discovery_control

from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import rate_gap
from .tables import ROWS, read_cells

ONE, TWO, THREE = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
DYNAMICS_ROWS = [row for row in ROWS if row.startswith("RGB+")]
SEEDED = "Only-RGB", "RGB+[P]", "RGB+[V]", "RGB+[P+V]", "RGB+[P+V+A]"  # the rows that carry the claims

DROPS = "Recurrent policies drop the block less often than feed-forward ones"
END_TO_END = "World models beat End-to-End"

Key = tuple[str, str, str, str]  # task, training, policy, row


def list_pairs() -> Iterator[tuple[str, str, Key, Key]]:
    """Claim, comparison, and the keys of the two cells of :func:`read_cells` that it compares."""
    columns = [
        ("task 1, feed-forward", (ONE, "decoupled", "feedforward")),
        ("task 1, recurrent", (ONE, "decoupled", "recurrent")),
        ("task 1, joint", (ONE, "joint", "recurrent")),
        ("task 2, joint", (TWO, "joint", "recurrent")),
        ("task 3, joint", (THREE, "joint", "recurrent")),
    ]
    for name, column in columns:
        for row in DYNAMICS_ROWS:
            yield "Dynamics beat Only-RGB", f"{name}: {row} - Only-RGB", (*column, row), (*column, "Only-RGB")
    feedforward = columns[0][1]
    for row in DYNAMICS_ROWS:
        if "V" not in row:
            pair = (*feedforward, "RGB+[V]"), (*feedforward, row)
            yield "Velocity helps the feed-forward policy most", f"RGB+[V] - {row}", *pair
    for row in ["Only-RGB", *DYNAMICS_ROWS]:
        pair = (ONE, "decoupled", "recurrent", row), (*feedforward, row)
        yield "Recurrent policies beat feed-forward ones", row, *pair
        yield DROPS, row, *pair
    for number, task in enumerate((ONE, TWO, THREE), start=1):
        for row in ["Only-RGB", *DYNAMICS_ROWS]:
            pair = (task, "decoupled", "recurrent", row), (task, "joint", "recurrent", row)
            yield "Decoupled training beats joint training", f"task {number}: {row}", *pair
    for number, task in enumerate((ONE, TWO, THREE), start=1):
        for training in ("decoupled", "joint"):
            pair = (task, training, "recurrent", "Only-RGB"), (task, "joint", "recurrent", "End-to-End")
            yield END_TO_END, f"task {number}: Only-RGB, {training} - End-to-End", *pair
    for claim, task in (("Transfer holds on task 2", TWO), ("Transfer fails on task 3", THREE)):
        for row in DYNAMICS_ROWS:
            pair = (task, "decoupled", "recurrent", row), (task, "decoupled", "recurrent", "Only-RGB")
            yield claim, f"{row} - Only-RGB", *pair


def compare_cells(results: Path) -> list[dict]:
    """A dict for every pair of which both cells are there: ``claim``, ``comparison``, ``rates`` of both (SR, of ``DROPS``
    DR, %), ``gap`` in points with its 95 % bootstrap ``interval`` over the start states, ``p`` of a paired permutation
    test, adjusted for all the comparisons made (Benjamini and Hochberg), and ``apart``: whether every policy of one
    has a higher rate than every policy of the other."""
    cells, rows = read_cells(results), []
    for claim, comparison, a, b in list_pairs():
        if a in cells and b in cells:
            name, outcome = ("DR", "dropped") if claim == DROPS else ("SR", "success")
            both = [result_rows(cells[key]) for key in (a, b)]
            each_a, each_b = (
                [np.mean([row[outcome] for row in seed]) for seed in rows_of] for rows_of in both
            )
            rows.append(
                {
                    "claim": claim,
                    "comparison": comparison,
                    "rates": [cells[key]["test_protocol"][name] for key in (a, b)],
                    **rate_gap(*both, outcome),
                    "apart": bool(min(each_a) > max(each_b) or max(each_a) < min(each_b)),
                }
            )
    for row, p in zip(rows, false_discovery_control([row["p"] for row in rows]) if rows else [], strict=True):
        row["p"] = float(p)
    return rows


def spread(results: Path) -> list[dict]:
    """For every row with more than one world-model seed: ``row``, ``SR`` of each (%, decoupled, recurrent, task 1), their
    ``mean`` and standard deviation ``std``."""
    seeds, rows = [read_cells(results, seed) for seed in range(3)], []
    for row in SEEDED:
        found = [cells.get((ONE, "decoupled", "recurrent", row)) for cells in seeds]
        rates = [result["test_protocol"]["SR"] for result in found if result]
        if len(rates) > 1:
            mean, std = float(np.mean(rates)), float(np.std(rates))
            rows.append({"row": row, "SR": rates, "mean": mean, "std": std})
    return rows


def markdown_findings(results: Path) -> str:
    """A table of the pairs under each claim."""
    parts, rows = [], compare_cells(results)
    for claim in dict.fromkeys(row["claim"] for row in rows):
        name = "DR" if claim == DROPS else "SR"
        lines = [
            f"**{claim}**",
            "",
            f"| | {name} | gap, points | p | policies apart |",
            "|---|---|---|---|---|",
        ]
        for row in rows:
            if row["claim"] == claim:
                rates = " - ".join(f"{rate:.1f}" for rate in row["rates"])
                low, high = row["interval"]
                gap = f"{row['gap']:+.1f} [{low:.1f}, {high:.1f}]"
                p = f"{row['p']:.3f}" if row["p"] >= 0.001 else "< 0.001"
                apart = "yes" if row["apart"] else "no"
                lines.append(f"| {row['comparison']} | {rates} | {gap} | {p} | {apart} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def markdown_spread(results: Path) -> str:
    """The same of :func:`spread`."""
    lines = ["| world models of several seeds | SR of each | mean (std) |", "|---|---|---|"]
    for row in spread(results):
        rates = ", ".join(f"{rate:.1f}" for rate in row["SR"])
        lines.append(f"| {row['row']} | {rates} | {row['mean']:.1f} ({row['std']:.1f}) |")
    return "\n".join(lines)
