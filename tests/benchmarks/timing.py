"""Comparison of two functions timed in turn, so that the load of the machine affects both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def compare(
    ours: Callable[[], float], theirs: Callable[[], float], repeats: int = 9, warm: bool = True
) -> dict[str, float]:
    """Return the medians of two functions' numbers, and the median of ours / theirs over the pairs.

    Args:
        ours: function that does its work and returns a number, seconds or a rate.
        theirs: the same for what it is compared with.
        repeats: number of pairs.
        warm: call both once before.
    """
    if warm:
        ours(), theirs()
    pairs = [(ours(), theirs()) for _ in range(repeats)]
    return {
        "ours": statistics.median(a for a, _ in pairs),
        "theirs": statistics.median(b for _, b in pairs),
        "ratio": statistics.median(a / b for a, b in pairs),
    }


def seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
