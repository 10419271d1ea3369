"""The paper's claims (Sec. V) as pairs of cells whose rates differ in the direction that the claim says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from .cells import TASKS, Key
from .published import find_numbers
from .results import ROWS

ONE, TWO, THREE = TASKS
ONLY_RGB, END_TO_END, PLAIN = "Only-RGB", "End-to-End", ", plain CNN"
DYNAMICS_ROWS = [row for row in ROWS if row.startswith("RGB+")]
FIRST = {  # columns of task 1
    "task 1, feed-forward": (ONE, "decoupled", "feedforward"),
    "task 1, recurrent": (ONE, "decoupled", "recurrent"),
    "task 1, joint": (ONE, "joint", "recurrent"),
}
TRANSFERS = {
    "task 2, decoupled": (TWO, "decoupled", "recurrent"),
    "task 2, joint": (TWO, "joint", "recurrent"),
    "task 3, decoupled": (THREE, "decoupled", "recurrent"),
    "task 3, joint": (THREE, "joint", "recurrent"),
}
FEEDFORWARD, RECURRENT, JOINT = FIRST.values()
DIRECTIONS = {"SR": 1, "DR": -1, "PE": -1}  # of what is better


@dataclass(frozen=True)
class Pair:
    """Two cells, or two differences of cells, that a claim compares.

    Attributes:
        claim: the claim.
        group: part of the claim in which comparisons are counted.
        comparison: description of the pair.
        a: key of a cell; or of two, of which the second is subtracted from the first.
        b: likewise; subtracted from ``a``.
        metric: ``SR``, ``DR`` or ``PE``.
        sign: sign of the gap by the claim, 1 or -1.
    """

    claim: str
    group: str
    comparison: str
    a: tuple[Key, ...]
    b: tuple[Key, ...]
    metric: str = "SR"
    sign: int = 1

    @property
    def terms(self) -> list[tuple[int, Key]]:
        """Signs and keys of all cells."""
        return [*zip((1, -1), self.a, strict=False), *zip((-1, 1), self.b, strict=False)]

    @property
    def paper_gap(self) -> float | None:
        """The paper's gap (points or mm), or None where it does not report the metric."""
        gap = 0.0
        for sign, (*column, row) in self.terms:
            numbers = find_numbers(*column, row.removesuffix(PLAIN)) or {}
            if self.metric not in numbers:
                return None
            gap += sign * numbers[self.metric][0]
        return gap


def list_pairs() -> list[Pair]:
    """Return the comparisons of all claims."""
    return [*_dynamics(), *_kinds_of_dynamics(), *_policies(), *_trainings(), *_transfers()]


def _better(
    claim: str, group: str, comparison: str, a: Key, b: Key, metrics: str = "SR,DR,PE"
) -> Iterator[Pair]:
    """Yield the pairs of a claim that cell ``a`` is better than ``b`` by each metric."""
    for metric in metrics.split(","):
        yield Pair(claim, group, comparison, (a,), (b,), metric, DIRECTIONS[metric])


def _dynamics() -> Iterator[Pair]:
    claim = "Dynamics are better than Only-RGB"
    for name, column in FIRST.items():
        for row in DYNAMICS_ROWS:
            yield from _better(claim, name, row, (*column, row), (*column, ONLY_RGB))
    for name in list(FIRST)[:2]:
        for row in DYNAMICS_ROWS:
            pair = (*FIRST[name], row + PLAIN), (*FIRST[name], ONLY_RGB + PLAIN)
            yield from _better(claim, name + PLAIN, row, *pair)


def _kinds_of_dynamics() -> Iterator[Pair]:
    columns = {
        name + form: (column, form) for form in ("", PLAIN) for name, column in list(FIRST.items())[:2]
    }
    for group, (column, form) in columns.items():
        p, v, a, p_v = ((*column, f"RGB+[{row}]{form}") for row in ("P", "V", "A", "P+V"))
        for name, other in (("P", p), ("A", a)):
            yield from _better(
                "Velocity is the best single quantity", group, f"RGB+[V] - RGB+[{name}]", v, other
            )
        for name, other in (("P", p), ("V", v)):
            claim = "Position and velocity are better together"
            yield from _better(claim, group, f"RGB+[P+V] - RGB+[{name}]", p_v, other)


def _policies() -> Iterator[Pair]:
    for form in ("", PLAIN):
        group = "task 1, decoupled" + form
        for row in (ONLY_RGB, *DYNAMICS_ROWS):
            pair = (*RECURRENT, row + form), (*FEEDFORWARD, row + form)
            yield from _better("Recurrent policies are better than feed-forward ones", group, row, *pair)
        for row in DYNAMICS_ROWS:
            of_row, of_rgb = (
                ((*RECURRENT, name + form), (*FEEDFORWARD, name + form)) for name in (row, ONLY_RGB)
            )
            yield Pair("Recurrent policies gain less by dynamics", group, row, of_row, of_rgb, "SR", -1)


def _trainings() -> Iterator[Pair]:
    columns = {"task 1": ONE, "task 2": TWO}
    for name, task in columns.items():
        for row in DYNAMICS_ROWS:
            pair = (task, "decoupled", "recurrent", row), (task, "joint", "recurrent", row)
            yield from _better("Decoupled training is better than joint training", name, row, *pair, "SR")
    pair = (*JOINT, ONLY_RGB), (*RECURRENT, ONLY_RGB)
    yield from _better("Joint training is better for Only-RGB", "task 1", ONLY_RGB, *pair, "SR")
    pair = (*JOINT, ONLY_RGB), (*JOINT, END_TO_END)
    yield from _better("World models are better than End-to-End", "task 1, joint", ONLY_RGB, *pair, "SR")


def _transfers() -> Iterator[Pair]:
    for name, column in TRANSFERS.items():
        for row in DYNAMICS_ROWS:
            pair = ((*column, row),), ((*column, ONLY_RGB),)
            if name == "task 3, joint":
                yield Pair("Dynamics are worse than Only-RGB", name, row, *pair, "SR", -1)
            else:
                metrics = "SR" if column[0] == THREE else "SR,DR"
                yield from _better(
                    "Dynamics are better than Only-RGB", name, row, *(*pair[0], *pair[1]), metrics
                )
    for training in ("decoupled", "joint"):
        for row in ROWS:
            first, second, third = ((task, training, "recurrent", row) for task in TASKS)
            if training == "joint" or row != END_TO_END:
                yield Pair("Task 2 is imitated better than task 1", training, row, (second,), (first,))
                yield Pair(
                    "Task 3, out of domain, is worse than task 1", training, row, (third,), (first,), "SR", -1
                )
