"""Angles of several episodes, aligned so that a pose has one value in all of them."""

from __future__ import annotations

import numpy as np

from .motion import Motion

ELONGATED = 1.3  # length to width of an object whose longest axis is known


def align_turns(angle: np.ndarray, rows: list[slice], period: float) -> None:
    """Shift episodes of unwrapped angles ``[N, D]`` in place by whole turns, so that a pose has one value in all of them.

    The circle is cut in the middle of the widest range of directions that no episode passes, and every episode is moved to
    the same side of the cut. Where together they go all the way round, this is done with their first steps alone. As many
    episodes as possible stay where they are.
    """
    for column in angle.T:
        first = np.array([column[own][0] for own in rows])
        low, high = (np.array([end(column[own]) for own in rows]) for end in (np.min, np.max))
        cut = _cut(low, high, period)
        turns = np.floor((first - (_cut(first, first, period) if cut is None else cut)) / period)
        for own, turn in zip(rows, turns - np.median(turns).round(), strict=True):
            column[own] -= period * turn


def _cut(low: np.ndarray, high: np.ndarray, period: float) -> float | None:
    """Return the middle of the widest gap between arcs of a circle, or None if they leave none."""
    order = np.argsort(low % period)
    start = (low % period)[order]
    end = start + (high - low)[order]
    reached = np.maximum.accumulate([end.max() - period, *end[:-1]])
    widest = (start - reached).argmax()
    gap = start[widest] - reached[widest]
    return start[widest] - gap / 2 if gap > 0 else None


def align_axes(angle: np.ndarray, episodes: list[tuple[slice, Motion]]) -> None:
    """Shift episodes of the angles of tracked objects ``[N, objects]`` in place, so that a pose has one value in all of them.

    The longest axis of an object has no direction. Its angle is counted from the horizontal or the vertical of the picture,
    whichever is nearer at the start of most episodes, and begins within a quarter of a turn of it; within an eighth for an
    object that is less than :data:`ELONGATED` times as long as wide.
    """
    from scipy.stats import circmean

    for n, column in enumerate(angle.T):
        found = [np.flatnonzero(motion.found[:, n])[:5] for _, motion in episodes]
        start = np.array(
            [np.median(column[own][seen]) for (own, _), seen in zip(episodes, found, strict=True)]
        )
        long = np.median([motion.tracks.elongation[n] for _, motion in episodes]) > ELONGATED
        period = np.pi if long else np.pi / 2
        axis = np.pi / 2 * np.round(circmean(start, period / 2, -period / 2) / (np.pi / 2))
        for (own, _), first in zip(episodes, start, strict=True):
            column[own] -= axis + period * np.round((first - axis) / period)
