"""Angles of several episodes, aligned so that a pose has one value in all of them."""

from __future__ import annotations

import numpy as np

from .motion import Motion

ELONGATED = 1.3  # length to width of an object whose longest axis is known


def align_turns(angle: np.ndarray, rows: list[slice], period: float) -> None:
    """Shift episodes of unwrapped angles ``[N, D]`` in place by whole turns, so that a pose has one value in all of them.

    The mean of each episode is moved to within half a turn of the mean direction of all.
    """
    from scipy.stats import circmean

    center = circmean(angle, period / 2, -period / 2, axis=0)
    for own in rows:
        angle[own] -= period * np.round((angle[own].mean(0) - center) / period)


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
