"""The paper's claims as comparisons of two cells each, on the start states that both share (paper, Sec. V)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import false_discovery_control

from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import rate_gap

from .results import ROWS, Key, read_cells
from .tables import join_table

ONE, TWO, THREE = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
DYNAMICS_ROWS = [row for row in ROWS if row.startswith("RGB+")]
LEVEL = 0.05  # of the adjusted p, below which a difference is clear

DROPS = "Recurrent policies drop the block less often than feed-forward ones"
FAILS = "Transfer fails on task 3"
NEGATIVE = DROPS, FAILS  # claims that a negative gap supports; any other is supported by a positive one


@dataclass(frozen=True)
class Pair:
    """Two cells that a claim compares.

    Attributes:
        claim: the claim.
        group: part of the claim in which comparisons are counted.
        comparison: description of the pair.
        a: key of a cell.
        b: key of the cell whose rate is subtracted.
    """

    claim: str
    group: str
    comparison: str
    a: Key
    b: Key

    @property
    def metric(self) -> tuple[str, str]:
        """Compared metric, and its entry in the episodes' rows."""
        return ("DR", "dropped") if self.claim == DROPS else ("SR", "success")


def list_pairs() -> list[Pair]:
    """Return the comparisons of all claims."""
    return [*_supervision(), *_policies(), *_trainings(), *_transfer()]


def _position(row: str) -> str:
    return "with position" if "P" in row else "without position"


def _supervision() -> Iterator[Pair]:
    columns = {
        "task 1, feed-forward": (ONE, "decoupled", "feedforward"),
        "task 1, recurrent": (ONE, "decoupled", "recurrent"),
        "task 1, joint": (ONE, "joint", "recurrent"),
        "task 2, joint": (TWO, "joint", "recurrent"),
        "task 3, joint": (THREE, "joint", "recurrent"),
    }
    for name, column in columns.items():
        for row in DYNAMICS_ROWS:
            pair = (*column, row), (*column, "Only-RGB")
            yield Pair("Dynamics beat Only-RGB", _position(row), f"{name}: {row} - Only-RGB", *pair)
    feedforward = columns["task 1, feed-forward"]
    for row in DYNAMICS_ROWS:
        if "V" not in row:
            pair = (*feedforward, "RGB+[V]"), (*feedforward, row)
            claim = "Velocity helps the feed-forward policy most"
            yield Pair(claim, f"against rows {_position(row)}", f"RGB+[V] - {row}", *pair)


def _policies() -> Iterator[Pair]:
    for claim in ("Recurrent policies beat feed-forward ones", DROPS):
        for row in ["Only-RGB", *DYNAMICS_ROWS]:
            pair = (ONE, "decoupled", "recurrent", row), (ONE, "decoupled", "feedforward", row)
            yield Pair(claim, _position(row), row, *pair)


def _trainings() -> Iterator[Pair]:
    tasks = {"task 1": ONE, "task 2": TWO, "task 3": THREE}
    for number, task in tasks.items():
        for row in ["Only-RGB", *DYNAMICS_ROWS]:
            pair = (task, "decoupled", "recurrent", row), (task, "joint", "recurrent", row)
            group = f"{number}, {_position(row)}"
            yield Pair("Decoupled training beats joint training", group, f"{number}: {row}", *pair)
    for number, task in tasks.items():
        for training in ("decoupled", "joint"):
            pair = (task, training, "recurrent", "Only-RGB"), (task, "joint", "recurrent", "End-to-End")
            comparison = f"{number}: Only-RGB, {training} - End-to-End"
            yield Pair("World models beat End-to-End", training, comparison, *pair)


def _transfer() -> Iterator[Pair]:
    for claim, task in (("Transfer holds on task 2", TWO), (FAILS, THREE)):
        for row in DYNAMICS_ROWS:
            pair = (task, "decoupled", "recurrent", row), (task, "decoupled", "recurrent", "Only-RGB")
            yield Pair(claim, _position(row), f"{row} - Only-RGB", *pair)


def compare_cells(results: Path) -> list[dict]:
    """Compare every pair of which both cells are in a folder of results.

    Returns:
        Dicts with ``claim``, ``group`` and ``comparison`` of the pair; ``rates`` of both (%); ``gap`` in points with its
        95 % bootstrap ``interval`` over the start states; ``p`` of a paired permutation test, adjusted for all
        comparisons (Benjamini and Hochberg); ``apart``, whether every policy of one cell has a higher rate than every
        policy of the other; and ``verdict``: ``agrees``, ``contradicts`` or ``unclear``.
    """
    cells = read_cells(results)
    rows = [_compare(pair, cells) for pair in list_pairs() if pair.a in cells and pair.b in cells]
    adjusted = false_discovery_control([row["p"] for row in rows]) if rows else []
    for row, p in zip(rows, adjusted, strict=True):
        row["p"] = float(p)
        supports = (row["gap"] < 0) == (row["claim"] in NEGATIVE)
        row["verdict"] = "unclear" if p >= LEVEL else "agrees" if supports else "contradicts"
    return rows


def _compare(pair: Pair, cells: dict[Key, dict]) -> dict:
    metric, outcome = pair.metric
    both = [result_rows(cells[key]) for key in (pair.a, pair.b)]
    each_a, each_b = ([np.mean([row[outcome] for row in seed]) for seed in rows_of] for rows_of in both)
    return {
        "claim": pair.claim,
        "group": pair.group,
        "comparison": pair.comparison,
        "rates": [cells[key]["test_protocol"][metric] for key in (pair.a, pair.b)],
        **rate_gap(*both, outcome),
        "apart": bool(min(each_a) > max(each_b) or max(each_a) < min(each_b)),
    }


def measure_spread(results: Path) -> list[dict]:
    """Measure how much decoupled cells of task 1 differ between world models of several seeds.

    Returns:
        For every row with more than one seed a dict with ``row``, ``SR`` of each seed (%), their ``mean`` and standard
        deviation ``std``.
    """
    seeds, rows = [read_cells(results, seed) for seed in range(3)], []
    for row in ROWS:
        found = [cells.get((ONE, "decoupled", "recurrent", row)) for cells in seeds]
        rates = [result["test_protocol"]["SR"] for result in found if result]
        if len(rates) > 1:
            rows.append({"row": row, "SR": rates, "mean": float(np.mean(rates)), "std": float(np.std(rates))})
    return rows


def markdown_claims(comparisons: list[dict]) -> str:
    """Return a table that counts the verdicts on every claim.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    lines = []
    for claim, group in dict.fromkeys((row["claim"], row["group"]) for row in comparisons):
        own = [row for row in comparisons if (row["claim"], row["group"]) == (claim, group)]
        counts = [
            str(sum(row["verdict"] == name for row in own)) for name in ("agrees", "contradicts", "unclear")
        ]
        gaps = sorted(row["gap"] for row in own)
        span = f"{gaps[0]:+.1f}" if len(gaps) == 1 else f"{gaps[0]:+.1f} to {gaps[-1]:+.1f}"
        lines.append([claim, group, *counts, span])
    return join_table(["claim", "comparisons", "agree", "contradict", "unclear", "gaps, points"], lines)


def markdown_comparisons(comparisons: list[dict]) -> str:
    """Return a table of the comparisons under each claim.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    parts = []
    for claim in dict.fromkeys(row["claim"] for row in comparisons):
        own = [row for row in comparisons if row["claim"] == claim]
        head = ["", "DR" if claim == DROPS else "SR", "gap, points", "p", "policies apart", "claim"]
        parts.append(f"**{claim}**\n\n{join_table(head, [_comparison_row(row) for row in own])}")
    return "\n\n".join(parts)


def _comparison_row(row: dict) -> list[str]:
    low, high = row["interval"]
    return [
        row["comparison"],
        " - ".join(f"{rate:.1f}" for rate in row["rates"]),
        f"{row['gap']:+.1f} [{low:.1f}, {high:.1f}]",
        f"{row['p']:.3f}" if row["p"] >= 0.001 else "< 0.001",
        "yes" if row["apart"] else "no",
        row["verdict"],
    ]


def markdown_spread(results: Path) -> str:
    """Return a table of :func:`measure_spread`."""
    lines = [
        [row["row"], ", ".join(f"{rate:.1f}" for rate in row["SR"]), f"{row['mean']:.1f} ({row['std']:.1f})"]
        for row in measure_spread(results)
    ]
    return join_table(["world models of several seeds", "SR of each", "mean (std)"], lines)
