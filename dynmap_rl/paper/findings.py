"""The paper's claims as comparisons of two cells each, on the start states that both share (paper, Sec. V).

Trainings of world models differ by more than the same policies on different scenes. A comparison therefore has a verdict
only where the gap is larger than both differences could explain.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product

from dynmap_rl.evaluation.statistics import paired_interval, rate_gap, welch_interval

from .cells import TASKS, Key
from .results import ROWS, Cell
from .tables import join_table, p_text

ONE, TWO, THREE = TASKS
DYNAMICS_ROWS = [row for row in ROWS if row.startswith("RGB+")]
HOLDS, FAILED, OPEN = VERDICTS = "holds", "does not hold", "open"

DROPS = "Recurrent policies drop the block less often than feed-forward ones"
LEVEL = 0.05  # largest p of a verdict


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
    return [*_supervision(), *_policies(), *_plain(), *_trainings(), *_transfer()]


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


def _plain() -> Iterator[Pair]:
    """Yield the pairs of world models with a plain CNN, whose success is further from 100 %."""
    rows = "RGB+[P+V], plain CNN", "Only-RGB, plain CNN"
    for policy in ("recurrent", "feedforward"):
        pair = ((ONE, "decoupled", policy, row) for row in rows)
        yield Pair(
            "With a plain CNN, dynamics beat Only-RGB", policy, f"{policy}: RGB+[P+V] - Only-RGB", *pair
        )
    for row in rows:
        pair = ((ONE, "decoupled", policy, row) for policy in ("recurrent", "feedforward"))
        name = row.split(",")[0]
        yield Pair("With a plain CNN, recurrent policies beat feed-forward ones", name, name, *pair)


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
    for claim, task in (
        ("Dynamics beat Only-RGB on task 2", TWO),
        ("Dynamics beat Only-RGB on task 3", THREE),
    ):
        for row in DYNAMICS_ROWS:
            pair = (task, "decoupled", "recurrent", row), (task, "decoupled", "recurrent", "Only-RGB")
            yield Pair(claim, _position(row), f"{row} - Only-RGB", *pair)


def compare_cells(cells: Mapping[Key, Cell]) -> list[dict]:
    """Compare every pair of which both cells have a complete run.

    Args:
        cells: result of :func:`dynmap_rl.paper.results.read_cells`.

    Returns:
        Dicts with ``claim``, ``group`` and ``comparison`` of the pair; ``rates`` of both (%); ``gap`` in points with its
        95 % bootstrap ``interval`` over the shared start states; ``p`` of a paired permutation test over them; the 95 %
        interval of the gap over ``trainings`` (see :func:`gap_over_trainings`); numbers of ``scenes`` and, for both, of
        ``world_models``; and ``verdict``. That is ``holds`` if p is below 0.05 and the interval over trainings is on the
        side that the claim says; ``does not hold`` if it is on the other side; else ``open``.
    """
    pairs = [
        pair for pair in list_pairs() if all(key in cells and cells[key].results for key in (pair.a, pair.b))
    ]
    return [_compare(pair, cells[pair.a], cells[pair.b]) for pair in pairs]


def gap_over_trainings(a: Cell, b: Cell, outcome: str = "success") -> tuple[float, float] | None:
    """Return the 95 % interval of the gap over world models (points), or None where their number says nothing.

    It is paired where both cells have policies on the same frozen world models, as recurrent and feed-forward policies
    of a row; otherwise Welch's.
    """
    rates_a, rates_b = a.rates(outcome), b.rates(outcome)
    pairs = product(zip(a.fingerprints, rates_a, strict=False), zip(b.fingerprints, rates_b, strict=False))
    if shared := [(ours, theirs) for (name, ours), (other, theirs) in pairs if name == other]:
        return paired_interval(*zip(*shared, strict=True))
    return welch_interval(rates_a, rates_b)


def _compare(pair: Pair, a: Cell, b: Cell) -> dict:
    metric, outcome = pair.metric
    found = rate_gap(a.policies, b.policies, outcome)
    trainings = gap_over_trainings(a, b, outcome)
    low, high = trainings if trainings and found["p"] < LEVEL else (0, 0)
    above, below = low > 0, high < 0
    if pair.claim == DROPS:  # a negative gap supports it
        above, below = below, above
    return {
        "claim": pair.claim,
        "group": pair.group,
        "comparison": pair.comparison,
        "rates": [a.summary[metric], b.summary[metric]],
        "gap": found["gap"],
        "interval": found["interval"],
        "p": found["p"],
        "trainings": trainings,
        "scenes": len(a.policies[0]),
        "world_models": [len(a.world_models), len(b.world_models)],
        "verdict": HOLDS if above else FAILED if below else OPEN,
    }


def judge_claim(comparisons: list[dict]) -> str:
    """Return the verdict on a claim: ``holds`` or ``does not hold`` if all of its comparisons say so, else ``open``."""
    verdicts = {row["verdict"] for row in comparisons}
    return verdicts.pop() if len(verdicts) == 1 else OPEN


def markdown_claims(comparisons: list[dict]) -> str:
    """Return a table of the verdicts on every claim, those without runs at the end.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    lines = []
    for claim, group in dict.fromkeys((row["claim"], row["group"]) for row in comparisons):
        own = [row for row in comparisons if (row["claim"], row["group"]) == (claim, group)]
        counts = [str(sum(row["verdict"] == verdict for row in own)) for verdict in VERDICTS]
        gaps = sorted(row["gap"] for row in own)
        span = f"{gaps[0]:+.1f}" if len(gaps) == 1 else f"{gaps[0]:+.1f} to {gaps[-1]:+.1f}"
        lines.append([claim, group, f"**{judge_claim(own)}**", *counts, span])
    compared = {tuple(line[:2]) for line in lines}
    for claim, group in dict.fromkeys((pair.claim, pair.group) for pair in list_pairs()):
        if (claim, group) not in compared:
            lines.append([claim, group, "no runs", *["0"] * len(VERDICTS), ""])
    return join_table(["claim", "comparisons", "verdict", *VERDICTS, "gaps, points"], lines)


def markdown_comparisons(comparisons: list[dict]) -> str:
    """Return a table of the comparisons under each claim.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    parts = []
    for claim in dict.fromkeys(row["claim"] for row in comparisons):
        own = [row for row in comparisons if row["claim"] == claim]
        head = [
            "",
            "DR" if claim == DROPS else "SR",
            "gap, points [scenes]",
            "p",
            "gap over world models",
            "scenes",
            "world models",
            "claim",
        ]
        parts.append(f"**{claim}**\n\n{join_table(head, [_comparison_row(row) for row in own])}")
    return "\n\n".join(parts)


def _comparison_row(row: dict) -> list[str]:
    low, high = row["interval"]
    return [
        row["comparison"],
        " - ".join(f"{rate:.1f}" for rate in row["rates"]),
        f"{row['gap']:+.1f} [{low:.1f}, {high:.1f}]",
        p_text(row["p"]),
        "[{:.1f}, {:.1f}]".format(*row["trainings"]) if row["trainings"] else "-",
        f"{row['scenes']:,}",
        " - ".join(map(str, row["world_models"])),
        row["verdict"],
    ]
