"""Quality of derived dynamics columns, estimated without the truth, and what to film differently.

Every check has a value, a limit, and advice. The limits (:data:`LIMITS`) were chosen by hand. They tell synthetic films and
positions with one known fault from those without (``tests/data/test_quality.py``). Success beside verdicts:
``dynmap_rl/data/README.md``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from .motion import Motion

EXPLAINED = 0.25  # share of the variance of colours that remains where objects have only changed places
SMOOTH = 7, 2  # window and order of the smooth trajectory
BY_EPISODE = "jumps", "order"  # checks that episodes pass or fail as a whole
RESTS = 0.1  # extent of an object that rests in an episode, as a share of the mean

# name: (limit, whether larger is worse, what is measured, advice)
LIMITS = {
    "lost": (
        0.05, True, "share of the frames in which an object is not found",
        "keep the object in view and unlike its surroundings in colour, or choose its --colors, --objects or --threshold",
    ),
    "gone": (
        0.5, True, "the same of the worst episode, whose columns are invented there",
        "delete that episode (lerobot-edit-dataset), or film it again",
    ),
    "cut": (
        0.05, True, "share of the frames in which an object touches the border of the picture",
        "film from farther away, so that the object never leaves the picture",
    ),
    "size": (
        4.0, False, "side of a square as large as the object, in pixels of a picture at most 160 wide",
        "film from nearer, or with less around the scene",
    ),
    "background": (
        0.5, True, "share of the picture that changes in an episode",
        "fix the camera, and remove what moves in the background; the light must not change",
    ),
    "step": (
        0.5, True, "motion of an object between two frames, 99th percentile, in sizes of the object",
        "film at a higher frame rate, or move more slowly",
    ),
    "jumps": (
        0.02, True, "share of the episodes in which a position jumps by more than a quarter of its extent in one step",
        "look at the frames there: the track has gone to another object, or the sensor failed, and all that follows may be "
        "wrong; name an angle of a state that jumps by its period in --angles, leave an entry that hardly moves out of "
        "--columns, or delete these episodes (lerobot-edit-dataset)",
    ),
    "residual": (
        0.02, True, "distance from a smooth trajectory, root mean square, as a share of the extent of the motion",
        "film from nearer, or leave an entry that hardly moves out of --columns; positions stay as measured, and only velocities "
        "gain by --method savgol with a longer --window",
    ),
    "residual_angle": (
        0.07, True, "distance of an angle from a smooth trajectory, root mean square (rad)",
        "film from nearer, or use --point for tracks without angles: a round object has none; only velocities gain by "
        "--method savgol with a longer --window",
    ),
    "order": (
        0.005, True, "share of the episodes in which an object has the colour that another one has in most",
        "name the objects by their --colors, or choose another --sort",
    ),
    "agreement": (
        0.7, False, "correlation of the tracks' velocity with that of the optical flow",
        "look at the picture of the tracks; velocities are not reliable",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Derived:
    """Dynamics of an episode from one source as they are written.

    Attributes:
        episode: index of the episode.
        names: names of the D entries.
        position: ``[T, D]``.
        velocity: ``[T, D]``.
        motion: what the source measured.
    """

    episode: int
    names: Sequence[str]
    position: np.ndarray
    velocity: np.ndarray
    motion: Motion


def judge_quality(derived: Sequence[Derived]) -> dict:
    """Measure the quality of derived columns.

    Args:
        derived: all episodes of the dataset, from every source.

    Returns:
        JSON values: ``verdict``, ``good`` or ``doubtful`` (a check fails); ``checks``, a dict by the names of
        :data:`LIMITS` of those that the source allows, each with ``value`` (of the worst object or entry), ``limit``,
        ``good``, ``where`` (that object or entry), ``episode`` (the worst one), ``episodes`` (all that are beyond the
        limit by themselves), ``what`` and ``advice``.
    """
    rows: dict[int, dict] = {}  # values by check and place, by episode
    steps = {part.episode: len(part.position) for part in derived}
    extents = _extents(derived)
    for part in derived:
        row = rows.setdefault(part.episode, {})
        for name, values in _measure(part, extents).items():
            row.setdefault(name, {}).update(values)
    tracked = [part for part in derived if part.motion.tracks and part.motion.found.shape[1] > 1]
    if len(tracked) > 2:  # two episodes of any colours may look alike
        for part, swapped in zip(
            tracked, _swapped([part.motion.tracks.color for part in tracked]), strict=True
        ):
            rows[part.episode]["order"] = {"objects": float(swapped)}
    checks = {}
    for name, (limit, more, what, advice) in LIMITS.items():
        found = [row[name] for row in rows.values() if row.get(name)]
        if not found:
            continue
        sign = 1 if more else -1
        weights = [1 if name in BY_EPISODE else steps[e] for e, row in rows.items() if row.get(name)]
        join = np.max if name == "gone" else partial(np.average, weights=weights)
        means = {where: float(join([row[where] for row in found])) for where in found[0]}
        where = max(means, key=lambda key, means=means, sign=sign: sign * means[key])
        worst = max(
            range(len(found)), key=lambda i, found=found, where=where, sign=sign: sign * found[i][where]
        )
        checks[name] = {
            "value": means[where],
            "limit": limit,
            "good": sign * means[where] <= sign * limit,
            "where": where,
            "episode": list(rows)[worst],
            "what": what,
            "advice": advice,
        }
        own = {e: row[name][where] for e, row in rows.items() if row.get(name)}
        checks[name]["episodes"] = [e for e, value in own.items() if sign * value > sign * limit]
    good = all(check["good"] for check in checks.values())
    return {"verdict": "good" if good else "doubtful", "checks": checks}


def quality_text(quality: dict) -> str:
    """Return the result of :func:`judge_quality` as lines of text."""
    lines = [f"derived columns: {quality['verdict']}"]
    for name, check in quality["checks"].items():
        relation = "at most" if LIMITS[name][1] else "at least"
        mark = "ok  " if check["good"] else "BAD "
        lines.append(
            f"  {mark} {name:14} {check['value']:8.3g}   ({relation} {check['limit']:g}; {check['where']}, worst in "
            f"episode {check['episode']}): {check['what']}"
        )
    lines += [
        f"  to do, {name}{_in_episodes(check)}: {check['advice']}"
        for name, check in quality["checks"].items()
        if not check["good"]
    ]
    return "\n".join(lines)


def _in_episodes(check: dict, most: int = 20) -> str:
    episodes = check.get("episodes", [])
    more = ", ..." * (len(episodes) > most)
    return f" (episodes {', '.join(map(str, episodes[:most]))}{more})" if episodes else ""


def _extents(derived: Sequence[Derived]) -> dict[str, float]:
    """Return the mean extent of every entry over the episodes, without the switches.

    Entries of a state may have different units; x, y and z of one body have one, as have all entries that are found in
    the frames, and share the largest extent. A switch is an entry with two values, such as a gripper that is open or
    closed, which may jump.
    """
    extents, values = {}, {}
    for part in derived:
        extent, motion = _extent(part.position), part.motion
        if motion.found is not None:
            extent[:] = np.delete(extent, motion.angles).max(initial=0.0)
        for name, own, column in zip(part.names, extent, part.position.T, strict=True):
            extents.setdefault(name, []).append(own)
            values[name] = np.unique(np.append(values.get(name, []), column))[:3]
    means = {name: float(np.mean(some)) for name, some in extents.items() if len(values[name]) > 2}
    bodies = {name: re.sub("[xyz]$", "", name) for name in means}
    return {
        name: max(means[other] for other in means if bodies[other] == body) for name, body in bodies.items()
    }


def _measure(episode: Derived, extents: dict[str, float]) -> dict[str, dict[str, float]]:
    """Return every measure of an episode by object or entry, given the mean extents of the entries."""
    names, position, motion = episode.names, episode.position, episode.motion
    lines = [i for i, name in enumerate(names) if i not in motion.angles and name in extents]
    extent = np.maximum([extents.get(name, 0.0) for name in names], 1e-9)
    rest = position - _smooth(position)
    rms = np.sqrt(np.square(rest).mean(0))
    result = {
        "residual": {names[i]: rms[i] / extent[i] for i in lines},
        "residual_angle": {names[i]: rms[i] * 2 * np.pi / motion.period for i in motion.angles},
        "jumps": {names[i]: float(_jumps(position[:, i], extent[i])) for i in lines},
    }
    if motion.found is not None:
        bodies = _bodies(names, motion.found.shape[1])
        result["lost"] = result["gone"] = dict(zip(bodies, 1 - motion.found.mean(0), strict=True))
    if (tracks := motion.tracks) is None:
        return result
    size = np.sqrt([np.median(area[area > 0]) for area in tracks.area.T])
    step = np.linalg.norm(np.diff(tracks.pose[..., :2], axis=0), axis=-1)
    result["cut"] = dict(zip(bodies, tracks.cut.mean(0), strict=True))
    result["size"] = dict(zip(bodies, size, strict=True))
    result["step"] = dict(zip(bodies, np.quantile(step, 0.99, axis=0) / size, strict=True))
    result["background"] = {"picture": tracks.moving}
    if motion.other is not None:
        entries = position.shape[1] // len(bodies)
        for n, body in enumerate(bodies):
            own = slice(entries * n, entries * n + 2)
            rests = _extent(position[:, own]).max() < RESTS * extent[own].max()
            agreement = 1.0 if rests else _correlation(episode.velocity[:, own], motion.other[:, own])
            result.setdefault("agreement", {})[body] = agreement
    return result


def _swapped(colors: list[np.ndarray]) -> np.ndarray:
    """Return for each episode whether its objects, whose colours are ``[N, 3]``, have changed places.

    Where colours differ from episode to episode for another reason, another order explains little of it.
    """
    from scipy.optimize import linear_sum_assignment

    given = np.array(colors, float)  # (E, N, 3)
    center = given[0]
    for _ in range(5):
        cost = np.square(given[:, :, None] - center).sum(-1)  # (E, N, N)
        order = np.array([linear_sum_assignment(own.T)[1] for own in cost])
        sorted_ = np.take_along_axis(given, order[..., None], 1)
        center = sorted_.mean(0)
    explained = sorted_.var(0).sum() < EXPLAINED * given.var(0).sum()
    usual = max(map(tuple, order), key=[*map(tuple, order)].count)
    return (order != usual).any(1) & explained


def _bodies(names: Sequence[str], count: int) -> list[str]:
    """Return the names of the objects, which begin those of their entries."""
    if count == 1:
        return [names[0].rpartition("_")[0] or "all that moves"]
    return [name.rpartition("_")[0] for name in names[:: len(names) // count]]


def _extent(position: np.ndarray) -> np.ndarray:
    """Return the range of each entry ``[T, D]`` without its outermost tenth, ``[D]``."""
    return np.quantile(position, 0.95, 0) - np.quantile(position, 0.05, 0)


def _smooth(position: np.ndarray) -> np.ndarray:
    from scipy.signal import savgol_filter

    window, order = SMOOTH
    return savgol_filter(position, window, order, axis=0) if len(position) >= window else position


def _jumps(values: np.ndarray, extent: float) -> bool:
    """Return whether a step is larger than a quarter of the extent and three times its neighbours."""
    from scipy.ndimage import median_filter

    step = np.abs(np.diff(values))
    return bool(((step > 0.25 * extent) & (step > 3 * median_filter(step, 7))).any())


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation of two velocities ``[T, 2]`` about 0; 1 where neither is anything but 0."""
    norm = np.sqrt(np.square(a).sum() * np.square(b).sum())
    return float((a * b).sum() / norm) if norm else 1.0


def worst_episode(quality: dict, names: Sequence[str] = ()) -> int:
    """Return the episode in which the check that is farthest beyond its limit, or nearest to it, is worst.

    Args:
        quality: result of :func:`judge_quality`.
        names: entries of the tracked objects, whose checks alone count; by default all checks do.
    """
    checks = quality["checks"].items()
    if names:
        tracked = {"picture", "objects", *names, *(name.rpartition("_")[0] for name in names)}
        checks = [(name, check) for name, check in checks if check["where"] in tracked]

    def excess(item: tuple[str, dict]) -> float:
        name, check = item
        ratio = check["value"] / check["limit"]
        return ratio if LIMITS[name][1] else 2 - ratio

    return max(checks, key=excess)[1]["episode"]
