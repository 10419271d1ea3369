"""The paper's claims, tested on the start states that all cells of a task share (paper, Sec. V).

Trainings of world models differ by more than the same policies on different scenes. A comparison therefore has a verdict
only where the gap is larger than both differences could explain.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from dynmap_rl.evaluation.statistics import outcome_gap, paired_interval, welch_interval

from .cells import TASKS, Key
from .claims import Pair, list_pairs
from .results import ROWS, Cell
from .tables import join_table, p_text, scene_gap_text

HOLDS, FAILED, OPEN = VERDICTS = "holds", "does not hold", "open"
MIXED = "mixed"
LEVEL = 0.05  # largest p of a verdict
METRICS = {"SR": ("success", "%"), "DR": ("dropped", "%"), "PE": ("position_error", "mm")}


def compare_cells(cells: Mapping[Key, Cell]) -> list[dict]:
    """Compare every pair of which all cells have a complete run.

    Args:
        cells: result of :func:`dynmap_rl.paper.results.read_cells`.

    Returns:
        Dicts with ``claim``, ``group``, ``comparison``, ``metric`` and ``sign`` of the pair; ``values`` of both sides and
        their ``gap`` (points, or mm of PE) with its 95 % ``interval`` over the shared start states; ``paper``,
        the paper's gap; ``p`` (see :func:`dynmap_rl.evaluation.outcome_gap`); the 95 % interval of the gap over
        ``trainings`` (see :func:`gap_over_trainings`); the number of ``world_models`` of both sides; and ``verdict``.
        That is ``holds`` if p is below 0.05 and the interval over trainings is on the side that the claim says; ``does
        not hold`` if p is below 0.05 and that interval is on the other side; else ``open``.
    """
    return [
        _compare(pair, cells)
        for pair in list_pairs()
        if all(key in cells and cells[key].results for _, key in pair.terms)
    ]


def gap_over_trainings(ours: Mapping[str, float], theirs: Mapping[str, float]) -> tuple[float, float] | None:
    """Return the 95 % interval of the gap over world models, or None where their number says nothing.

    It is paired where both sides have policies on the same world models and no others, as recurrent and feed-forward
    policies of a row, or a row on two tasks; otherwise Welch's.

    Args:
        ours: mean outcome of each world model, by its fingerprint.
        theirs: likewise; subtracted.
    """
    if ours.keys() == theirs.keys():
        return paired_interval([*ours.values()], [theirs[name] for name in ours])
    return welch_interval([*ours.values()], [*theirs.values()])


def _by_world_model(side: Sequence[Cell], outcome: str) -> dict[str, float]:
    """Return the mean outcome of each world model (% or mm) by its fingerprint; of two cells the difference."""
    first, *rest = (dict(zip(cell.fingerprints, cell.rates(outcome), strict=True)) for cell in side)
    for second in rest:
        first = {name: rate - second[name] for name, rate in first.items() if name in second}
    return first


def _compare(pair: Pair, cells: Mapping[Key, Cell]) -> dict:
    outcome, _ = METRICS[pair.metric]
    found = outcome_gap([(sign, cells[key].policies) for sign, key in pair.terms], outcome)
    sides = [[cells[key] for key in side] for side in (pair.a, pair.b)]
    ours, theirs = (_by_world_model(side, outcome) for side in sides)
    trainings = gap_over_trainings(ours, theirs)
    low, high = trainings if trainings and found["p"] < LEVEL else (0, 0)
    above, below = (low > 0, high < 0)[:: pair.sign]
    values = [[cell.summary[pair.metric] for cell in side] for side in sides]
    return {
        "claim": pair.claim,
        "group": pair.group,
        "comparison": pair.comparison,
        "metric": pair.metric,
        "values": [first - sum(rest) for first, *rest in values],
        "gap": found["gap"],
        "paper": pair.paper_gap,
        "interval": found["interval"],
        "p": found["p"],
        "trainings": trainings,
        "world_models": [len(ours), len(theirs)],
        "verdict": HOLDS if above else FAILED if below else OPEN,
    }


def judge_claim(comparisons: list[dict], count: int) -> str:
    """Return the verdict on a claim.

    ``holds`` if all of its comparisons hold; ``does not hold`` if some do not and none holds; ``mixed`` if some hold and
    some do not; else ``open``.

    Args:
        comparisons: those of the claim that have results.
        count: number of the claim's comparisons.
    """
    verdicts = {row["verdict"] for row in comparisons}
    if FAILED in verdicts:
        return MIXED if HOLDS in verdicts else FAILED
    return HOLDS if verdicts == {HOLDS} and len(comparisons) == count else OPEN


def markdown_claims(comparisons: list[dict]) -> str:
    """Return a table of the verdicts on every claim, with the paper's gaps, and below it what has no runs.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    lines, verdicts, missing, pairs = [], [], {}, list_pairs()
    claims = list(dict.fromkeys(pair.claim for pair in pairs))
    parts = Counter((pair.claim, pair.group, pair.metric) for pair in pairs)
    for part in sorted(parts, key=lambda part: claims.index(part[0])):
        own = [row for row in comparisons if (row["claim"], row["group"], row["metric"]) == part]
        if not own:
            missing.setdefault(part[0], {})[part[1]] = None
            continue
        counts = [str(sum(row["verdict"] == verdict for row in own)) for verdict in VERDICTS]
        unit = METRICS[part[2]][1].replace("%", "points")
        gaps = [_span([row["paper"] for row in own], 0), f"{_span([row['gap'] for row in own], 1)} {unit}"]
        verdicts.append(judge_claim(own, parts[part]))
        some = f" ({len(own)} of {parts[part]} have runs)" if len(own) < parts[part] else ""
        lines.append([part[0], part[1] + some, part[2], *gaps, *counts, f"**{verdicts[-1]}**"])
    head = ["claim", "comparisons", "metric", "the paper's gaps", "gaps", *VERDICTS, "verdict"]
    rest = "".join(f"\n- {claim}: {'; '.join(groups)}" for claim, groups in missing.items())
    count = ", ".join(f"{name}: {verdicts.count(name)}" for name in (HOLDS, FAILED, MIXED, OPEN))
    table = join_table(head, lines) + (f"\n\nWithout runs so far:\n{rest}" if rest else "")
    return f"Verdicts on {len(lines)} claims about a metric: {count}.\n\n{table}"


def _span(gaps: list[float], digits: int) -> str:
    """Return the smallest and the largest gap, where they differ as printed."""
    ends = (round(gap, digits) + 0.0 for gap in (min(gaps), max(gaps)))  # no -0
    return " to ".join(dict.fromkeys(f"{gap:+.{digits}f}" for gap in ends))


def markdown_comparisons(comparisons: list[dict]) -> str:
    """Return a table of the comparisons under each claim.

    Args:
        comparisons: result of :func:`compare_cells`.
    """
    head = [
        "comparison",
        "metric",
        "values",
        "gap [scenes]",
        "p",
        "gap over world models",
        "world models",
        "the paper's gap",
        "verdict",
    ]
    parts = []
    for claim in dict.fromkeys(row["claim"] for row in comparisons):
        own = [_comparison_row(row) for row in comparisons if row["claim"] == claim]
        parts.append(f"**{claim}**\n\n{join_table(head, own)}")
    return "\n\n".join(parts)


def _comparison_row(row: dict) -> list[str]:
    return [
        f"{row['group']}: {row['comparison']}",
        f"{row['metric']} {METRICS[row['metric']][1]}",
        ", ".join(f"{value:.1f}" for value in row["values"]),
        scene_gap_text(row),
        p_text(row["p"]),
        "[{:.1f}, {:.1f}]".format(*row["trainings"]) if row["trainings"] else "-",
        ", ".join(map(str, row["world_models"])),
        "" if row["paper"] is None else f"{row['paper']:+.0f}",
        row["verdict"],
    ]


def markdown_transfer(cells: Mapping[Key, Cell]) -> str:
    """Return a table of how far the frozen world models' predicted positions are from the true ones, by task.

    Args:
        cells: result of :func:`dynmap_rl.paper.results.read_cells`.
    """
    lines = []
    for row in ROWS:
        of_tasks = [cells.get((task, "decoupled", "recurrent", row)) for task in TASKS]
        errors = [
            [found.get("test_protocol", {}).get("localization") for found in cell.results] if cell else [None]
            for cell in of_tasks
        ]
        if all(values and None not in values for values in errors):
            lines.append([row, *(f"{np.mean(values):.1f}" for values in errors)])
    return join_table(["distance of predicted and true cart, mm", "task 1", "task 2", "task 3"], lines)
