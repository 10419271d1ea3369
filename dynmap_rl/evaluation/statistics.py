"""Drop rate, position error and success rate, with their uncertainty."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Sequence
from statistics import NormalDist

import numpy as np

FEW = 10  # successes or failures
EQUAL = 1e-9  # rates (%) that differ by less are equal, but for rounding

# SciPy is imported where it is used: it takes a second, also in every process of an evaluation.


def summarize(rows: list[dict]) -> dict:
    """Summarise episode rows (paper, Sec. V-B).

    Args:
        rows: see :func:`dynmap_rl.evaluation.episode_rows`.

    Returns:
        ``DR`` and ``SR`` (%) with 95 % Wilson intervals for independent episodes, ``PE`` (mm), the number of
        ``episodes`` and, where the rows have them, the share of episodes in which a wall was touched (``touched``, %),
        the error of the predicted position of the first body (``localization``, mm) and the number of failed episodes by
        cause (``causes``, the most frequent first).
    """
    count = len(rows)
    dropped = sum(row["dropped"] for row in rows)
    success = sum(row["success"] for row in rows)
    summary = {
        "episodes": count,
        "DR": 100 * dropped / count,
        "DR_interval": wilson(dropped, count),
        "PE": 1000 * float(np.mean([row["position_error"] for row in rows])),
        "SR": 100 * success / count,
        "SR_interval": wilson(success, count),
    }
    if "touched" in rows[0]:
        summary["touched"] = 100 * sum(row["touched"] for row in rows) / count
    if errors := [row["localization_error"] for row in rows if "localization_error" in row]:
        summary["localization"] = 1000 * float(np.mean(errors))
    if causes := Counter(row["cause"] for row in rows if "cause" in row):
        summary["causes"] = dict(causes.most_common())
    return summary


def summary_text(summary: dict) -> str:
    """Return a summary as a line of text, and another one for the failures by cause if there are any."""
    low, high = summary["SR_interval"]
    line = f"DR {summary['DR']:.1f} %   PE {summary['PE']:.1f} mm   SR {summary['SR']:.1f} % [{low:.1f}, {high:.1f}]"
    return f"{line}\n{causes_text(summary)}".rstrip()


def causes_text(summary: dict) -> str:
    """Return the failures of a summary by cause as a line of text, such as ``failures: stops short 3``, or ""."""
    counts = ", ".join(f"{cause} {count}" for cause, count in summary.get("causes", {}).items())
    return f"failures: {counts}" if counts else ""


def summarize_seeds(rows_by_seed: list[list[dict]]) -> dict[str, tuple[float, float]]:
    """Return mean and standard deviation over policy seeds of DR (%), PE (mm) and SR (%): the paper's protocol."""
    summaries = [summarize(rows) for rows in rows_by_seed]
    return {
        key: (float(np.mean([s[key] for s in summaries])), float(np.std([s[key] for s in summaries])))
        for key in ("DR", "PE", "SR")
    }


def wilson(successes: float, count: float) -> tuple[float, float]:
    """Return the 95 % Wilson interval of a rate, in %; SciPy has it for whole numbers only."""
    rate, z = successes / count, NormalDist().inv_cdf(0.975)
    middle = rate + z**2 / (2 * count)
    half = z * (rate * (1 - rate) / count + z**2 / (4 * count**2)) ** 0.5
    low, high = (100 * (middle + sign * half) / (1 + z**2 / count) for sign in (-1, 1))
    return max(low, 0.0), min(high, 100.0)


def shared_interval(rows_by_seed: list[list[dict]], outcome: str = "success") -> tuple[float, float]:
    """Return the 95 % interval of a rate over policy seeds that share their start states, in %.

    These episodes are not independent: a start state that is hard for one policy is hard for the others. The result is
    Wilson's interval for the effective number of independent episodes (Kish), which follows from the variance of the
    means over the seeds. It is at least the number of start states, and at most the number of episodes. With fewer
    than ten successes or failures, whose variance says little, it is the number of start states.

    Args:
        rows_by_seed: rows of the same scenes in the same order for every policy seed.
        outcome: entry of the rows that is counted.
    """
    values = np.array([[row[outcome] for row in rows] for rows in rows_by_seed], float)  # [seeds, starts]
    rate, starts = values.mean(), values.shape[1]
    few = min(values.sum(), values.size - values.sum()) < FEW
    spread = values.mean(0).var(ddof=1) / starts if starts > 1 and not few else 0.0
    count = np.clip(rate * (1 - rate) / spread, starts, values.size) if spread else starts
    return wilson(float(rate * count), float(count))


def student_interval(rates: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval (Student's t) of the mean of rates, such as those of several world models.

    Args:
        rates: a rate for each, in %.

    Returns:
        The ends, within 0 and 100 %; None for fewer than two rates, or equal ones, which do not say how rates vary.
    """
    from scipy.stats import ttest_1samp

    if len(rates) < 2 or np.ptp(rates) < EQUAL:
        return None
    found = ttest_1samp(rates, 0).confidence_interval()
    return max(float(found.low), 0.0), min(float(found.high), 100.0)


def welch_interval(rates_a: Sequence[float], rates_b: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval (Welch's t) of the difference of two means of rates, such as those of world models.

    Args:
        rates_a: a rate for each, in %.
        rates_b: likewise; its mean is subtracted.

    Returns:
        The ends, in points; None for fewer than two rates on a side, or if neither side varies.
    """
    from scipy.stats import ttest_ind

    if min(len(rates_a), len(rates_b)) < 2 or max(np.ptp(rates_a), np.ptp(rates_b)) < EQUAL:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that one side does not vary
        found = ttest_ind(rates_a, rates_b, equal_var=False).confidence_interval()
    return float(found.low), float(found.high)


def mean_gap(pairs: Sequence[tuple[Sequence[float], Sequence[float]]]) -> tuple[float, float, float] | None:
    """Return the mean over tasks of the difference of two means of rates, with its 95 % interval (Welch-Satterthwaite).

    Args:
        pairs: for each task the rates of both sides, in %; the second mean is subtracted.

    Returns:
        The mean and the ends, in points; None for fewer than two rates on a side, or if no side varies.
    """
    from scipy.stats import t

    sides = [np.asarray(side, float) for pair in pairs for side in pair]
    if not sides or min(map(len, sides)) < 2 or max(map(np.ptp, sides)) < EQUAL:
        return None
    gap = float(np.mean([np.mean(a) - np.mean(b) for a, b in pairs]))
    shares = np.array([side.var(ddof=1) / len(side) for side in sides])
    freedom = shares.sum() ** 2 / sum(
        share**2 / (len(side) - 1) for share, side in zip(shares, sides, strict=True)
    )
    half = float(t.ppf(0.975, freedom)) * shares.sum() ** 0.5 / len(pairs)
    return gap, gap - half, gap + half


def paired_interval(rates_a: Sequence[float], rates_b: Sequence[float]) -> tuple[float, float] | None:
    """Return the 95 % interval (paired t) of the mean difference of rates, such as those of one world model each.

    Args:
        rates_a: a rate for each, in %.
        rates_b: likewise, in the same order; subtracted.

    Returns:
        The ends, in points; None for fewer than two pairs, or equal differences.
    """
    from scipy.stats import ttest_rel

    if len(rates_a) < 2 or np.ptp(np.subtract(rates_a, rates_b)) < EQUAL:
        return None
    found = ttest_rel(rates_a, rates_b).confidence_interval()
    return float(found.low), float(found.high)


def outcome_gap(terms: Sequence[tuple[int, list[list[dict]]]], outcome: str = "success") -> dict:
    """Compare the mean outcomes of results on the same start states.

    Args:
        terms: for each result its sign, 1 or -1, and its rows: a list for each policy seed, all over the same scenes in
            the same order. Two terms with 1 and -1 are the difference of two results.
        outcome: entry of the rows: a flag, or ``position_error``.

    Returns:
        ``gap``, the sum of the means with their signs, in percentage points or mm; its 95 % ``interval`` over the start
        states, after averaging over policy seeds, None if they do not differ; and ``p``, the two-sided probability of a
        gap of this size if the true gap is zero. For flags, the interval is a bootstrap and ``p`` an exact sign-flip test
        over the start states; for ``position_error``, both are of a t test.

    Raises:
        ValueError: the results are not on the same scenes.
    """
    from scipy.stats import bootstrap, ttest_1samp

    scenes = [[row["scene_seed"] for row in rows] for _, policies in terms for rows in policies]
    if any(s != scenes[0] for s in scenes):
        raise ValueError(
            "results must be on the same start states, got different scenes; evaluate them again"
        )
    flags = isinstance(terms[0][1][0][0][outcome], bool | np.bool_)
    # Sums of flags are whole numbers, so that a tie is one.
    unit = math.lcm(*(len(policies) for _, policies in terms))
    sums = sum(
        sign * (unit // len(policies)) * np.sum([[row[outcome] for row in rows] for rows in policies], axis=0)
        for sign, policies in terms
    )
    difference = (100 if flags else 1000) * sums / unit
    gap = float(difference.mean())
    if not np.ptp(difference):
        return {"gap": gap, "interval": None, "p": exchange_p(sums) if flags else float(not gap)}
    if flags:
        rng, p = np.random.default_rng(0), exchange_p(sums)
        interval = bootstrap((difference,), np.mean, batch=1000, rng=rng).confidence_interval
    else:
        test = ttest_1samp(difference, 0)
        interval, p = test.confidence_interval(), float(test.pvalue)
    return {"gap": gap, "interval": (float(interval.low), float(interval.high)), "p": p}


def exchange_p(differences: np.ndarray) -> float:
    """Return the two-sided p of the sum of whole numbers if every sign were drawn at random.

    The result is exact. SciPy's permutation test draws a sample and takes a thousand times as long.
    """
    from scipy.stats import binom

    sizes, counts = np.unique(np.abs(differences[differences != 0]), return_counts=True)
    unit = max(np.gcd.reduce(sizes, initial=0), 1)
    chances = np.ones(1)  # of the sums, in steps of the unit
    for size, count in zip(sizes // unit, counts, strict=True):
        of_size = np.zeros(2 * size * count + 1)
        of_size[:: 2 * size] = binom.pmf(np.arange(count + 1), count, 0.5)
        chances = np.convolve(chances, of_size)
    sums = unit * (np.arange(len(chances)) - len(chances) // 2)
    return min(float(chances[np.abs(sums) >= abs(differences.sum())].sum()), 1.0)
