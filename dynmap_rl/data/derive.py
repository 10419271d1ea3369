"""Dynamics columns for datasets without them: positions of a state or of the frames, and their derivatives."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dynmap_rl.envs.task import BODIES, LAYOUT
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.keys import DYNAMICS, FOUND

from .angles import align_axes, align_turns
from .camera import FrameSource, choose_view, read_motion
from .demonstrations import DERIVED, META, find_layout, find_meta
from .format.columns import write_columns
from .format.reading import find_dataset, read_column, read_info, read_table, spans
from .motion import Motion
from .normalization import planar_range, value_range
from .quality import Derived, judge_quality
from .state import choose_state, read_state

METHODS = ("central", "savgol")
SOURCES = "state", "centroid", "tracks", "flow", "state,tracks", "state,flow"


def differentiate(
    position: np.ndarray, time: np.ndarray, method: str = "central", window: int = 11, order: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Compute velocity and acceleration from positions.

    Both methods use later steps: the results are labels, and no policy may read them.

    Args:
        position: positions ``[T, D]`` of one episode, float64.
        time: their times ``[T]`` (s).
        method: ``central`` (differences over both neighbours by ``numpy.gradient``, of second order at uneven times
            too, twice for the acceleration) or ``savgol`` (derivatives of a polynomial fitted to each window, for noisy
            positions at even times).
        window: steps of the window of ``savgol``.
        order: order of the polynomial of ``savgol``.

    Returns:
        Velocity and acceleration ``[T, D]``, per s and per s^2, float64.

    Raises:
        ValueError: there are too few steps, or times do not increase or, for ``savgol``, are not uniform. The message
            is the end of a sentence.
    """
    from scipy.signal import savgol_filter

    steps = np.diff(time)
    needed = window if method == "savgol" else 3
    if len(position) < needed:
        raise ValueError(f"must have at least {needed} steps for --method {method}, got {len(position)}")
    if not (steps > 0).all():
        raise ValueError("must have timestamps that increase")
    if method == "central":
        velocity = np.gradient(position, time, axis=0, edge_order=2)
        return velocity, np.gradient(velocity, time, axis=0, edge_order=2)
    mean = (time[-1] - time[0]) / (len(time) - 1)
    # Timestamps are stored as float32: they are as uniform as its precision allows.
    if np.abs(steps - mean).max() > 0.01 * mean + 2 * np.spacing(np.float32(time[-1])):
        raise ValueError(
            f"must have uniform timestamps for --method savgol, got distances of {steps.min():.4g} to "
            f"{steps.max():.4g} s; use --method central"
        )
    velocity, acceleration = (savgol_filter(position, window, order, k, mean, axis=0) for k in (1, 2))
    return velocity, acceleration


def add_dynamics(
    dataset: str | Path,
    output: str | Path,
    source: str = "state",
    state: str = "observation.state",
    columns: Iterable[int] | None = None,
    angles: Iterable[int] = (),
    period: float = 2 * math.pi,
    noise: float = 0.0,
    angle_noise: float = 0.0,
    noise_seed: int = 0,
    method: str | None = None,
    window: int = 11,
    order: int = 3,
    camera: str | None = None,
    objects: int | None = None,
    colors: Sequence[str] | None = None,
    threshold: int = 30,
    sort: str = "lowest",
    point: bool = False,
    width: float | None = None,
    replace: bool = False,
) -> dict:
    """Copy a LeRobot v3.0 dataset and add the columns ``dynamics.position``, ``.velocity`` and ``.acceleration``.

    The columns (float32) are computed for one episode at a time, in float64, with the times of the column ``timestamp``.
    From frames there is also ``dynamics.found`` (bool): whether what an entry belongs to was found in the frame. Other
    positions are interpolated, and trainings leave these entries out. The new folder appears when it is complete. Videos
    are hard-linked where the file system can; all other files are copied. A recording of a task stays one, and can be
    trained on with the recipes of the tasks: its constants of normalisation and the names of its dynamics are written anew.
    ``meta/dynamics.json`` has all settings, and the quality of the columns.

    Args:
        dataset: local folder or hub id.
        output: the new folder.
        source: ``state``, or from the frames ``centroid``, ``tracks`` or ``flow`` (see
            :class:`dynmap_rl.data.camera.FrameSource`), or both: ``state,tracks`` or ``state,flow``.
        state: column whose entries are positions. They stay as measured, except for unwrapped angles.
        columns: entries of that column; by default all.
        angles: entries among ``columns`` that are angles and jump by ``period``.
        period: 2 pi for radians, 360 for degrees.
        noise: standard deviation of normal noise that is added to the positions of a state, for experiments, in their
            unit.
        angle_noise: likewise of the angles.
        noise_seed: seed of the noise.
        method: ``central`` or ``savgol`` (see :func:`differentiate`); by default central for a state, savgol for frames.
        window: steps of the window of ``savgol``.
        order: order of the polynomial of ``savgol``.
        camera: column of the frames; by default the first camera.
        objects: number of objects in the frames, for ``tracks`` and ``flow``; by default the number of bodies of a task
            in the plane, otherwise one.
        colors: colour of each object, such as ``"#1c1c1c"`` or ``"red"``, instead of ``objects`` and ``sort``.
        threshold: smallest difference of a colour channel of a pixel that moves, and of two colours.
        sort: order of the objects (see :func:`dynmap_rl.data.tracking.track_objects`).
        point: leave the angles of tracked objects out.
        width: width of the picture (m); by default 1 for a task in the plane, otherwise positions are in pixels.
        replace: replace existing dynamics columns.

    Returns:
        ``differences``, the mean absolute difference from replaced columns, ``[D]`` by quantity; ``quality`` (see
        :func:`dynmap_rl.data.quality.judge_quality`); and ``view``, the camera with all defaults, None for a state.

    Raises:
        ValueError: an argument is wrong, or the dataset is damaged or does not allow it.
        OSError: the folder cannot be written.
    """
    root, output = find_dataset(dataset), Path(output).expanduser()
    info, meta = read_info(root), find_meta(root)
    old = [name for q in DYNAMICS if (name := f"dynamics.{q}") in info["features"]]
    if old and not replace:
        raise ValueError(f"{root} must not have {', '.join(old)}; replace them with --replace")
    _check_output(root, output)
    if source not in SOURCES:
        raise ValueError(f"--source must be one of {', '.join(map(repr, SOURCES))}, got {source!r}")
    _check_method(method or ("central" if source == "state" else "savgol"), window, order)
    planar = meta is not None and _is_planar(meta["task"])
    parts, entries, view = [], None, None  # names, motions by episode, and method
    if "state" in source:
        entries = choose_state(info, state, columns, angles, period, noise, angle_noise, noise_seed)
        parts.append((entries.names, read_state(root, info, entries), method or "central"))
    if source != "state":
        frames = {"camera": camera, "objects": objects, "colors": colors, "threshold": threshold}
        frames |= {"sort": sort, "point": point, "width": width}
        view = choose_view(root, info, source.removeprefix("state,"), planar, **frames)
        parts.append((view.names, read_motion(root, info, view), method or "savgol"))
    names = [name for part in parts for name in part[0]]
    ordered = view and view.sort == "lowest" and not view.colors  # the cart is below the block
    if planar and ordered and view.names == FrameSource("tracks", "", len(BODIES) // 3).names == names:
        names = list(BODIES)
        parts = [(names, *parts[0][1:])]
    if len(set(names)) < len(names):
        raise ValueError(
            f"names of the dynamics must be different, got {', '.join(names)}; take other --columns"
        )
    table = read_table(root, info, ["timestamp", *old])
    time = read_column(root, info, table, "timestamp", np.float64).numpy()[:, 0]
    rows = dict(spans(table["episode_index"].to_numpy()))
    _check_lengths(root, rows, [part[2] for part in parts], window)
    values, derived, start = {q: np.empty((len(table), len(names))) for q in DYNAMICS}, [], 0
    seen = np.ones((len(table), len(names)), dtype=bool)
    for own_names, motions, own_method in parts:
        own, first = slice(start, start := start + len(own_names)), len(derived)
        for episode, motion in motions:
            try:
                found, motion = _derive(motion, time[rows[episode]], own_method, window, order)
            except ValueError as error:
                raise ValueError(f"{root}: episode {episode} {error}") from error
            for quantity, part in found.items():
                values[quantity][rows[episode], own] = part
            if motion.found is not None:
                seen[rows[episode], own] = motion.found.repeat(len(own_names) // motion.found.shape[1], 1)
            derived.append(Derived(episode, own_names, found["position"], found["velocity"], motion))
        angle = values["position"][:, own][:, motion.angles]
        if motion.tracks:
            align_axes(angle, [(rows[part.episode], part.motion) for part in derived[first:]])
        else:
            align_turns(angle, list(rows.values()), motion.period)
        values["position"][:, own][:, motion.angles] = angle
    new = {f"dynamics.{q}": v.astype(np.float32) for q, v in values.items()}
    if view or FOUND in info["features"]:
        new[FOUND] = seen
    meta = _describe(meta, planar, names, values, rows) if meta else None
    differences = {}
    for name in old:
        quantity = name.removeprefix("dynamics.")
        with contextlib.suppress(ValueError):  # damaged columns may be replaced too
            before = read_column(root, info, table, name, np.float64).numpy()
            if before.shape == values[quantity].shape:
                differences[quantity] = np.abs(values[quantity] - before).mean(0)
    quality = judge_quality(derived)
    how = {"source": source, "methods": [part[2] for part in parts], "window": window, "order": order}
    how |= {"state": entries and dataclasses.asdict(entries), "frames": view and dataclasses.asdict(view)}
    how |= quality | {"differences": {q: d.tolist() for q, d in differences.items()}}
    write_columns(root, output, info, table, new, names, {META: meta, DERIVED: how})
    return {"differences": differences, "quality": quality, "view": view}


def _derive(
    motion: Motion, time: np.ndarray, method: str, window: int, order: int
) -> tuple[dict[str, np.ndarray], Motion]:
    """Return position, velocity and acceleration of an episode, with angles unwrapped, and what was measured."""
    position = motion.position
    position[:, motion.angles] = np.unwrap(position[:, motion.angles], axis=0, period=motion.period)
    velocity, acceleration = differentiate(position, time, method, window, order)
    if motion.velocity is not None:
        motion = dataclasses.replace(motion, other=velocity)
        velocity = motion.velocity
        acceleration = differentiate(velocity, time, method, window, order)[0]
    return {"position": position, "velocity": velocity, "acceleration": acceleration}, motion.light()


def _check_lengths(root: Path, rows: dict[int, slice], methods: list[str], window: int) -> None:
    needed = window if "savgol" in methods else 3
    lengths = {episode: own.stop - own.start for episode, own in rows.items()}
    if short := [f"{episode} ({length} steps)" for episode, length in lengths.items() if length < needed]:
        shorter = "use --method central or a shorter --window, or " if needed > 3 else ""
        raise ValueError(
            f"{root} must have at least {needed} steps in every episode, got fewer in {', '.join(short)}; {shorter}delete "
            "these episodes (lerobot-edit-dataset)"
        )


def _is_planar(task: str) -> bool:
    """Return whether a task that a dataset names is known and in the plane; a dataset must not run code."""
    try:
        return get_task(task, from_file=True).planar
    except ValueError:
        return False


def _describe(
    meta: dict, planar: bool, names: list[str], values: dict[str, np.ndarray], rows: dict[int, slice]
) -> dict | None:
    """Return the metadata of a recording with other dynamics; None where the recipes of its task cannot read them."""
    kinds = [name.rpartition("_")[2] for name in names]
    if planar and kinds != np.resize(["x", "y", "theta"], len(names)).tolist():
        return None  # augmentation takes entries for x, y and theta
    train = np.concatenate([np.arange(rows[e].start, rows[e].stop) for e in range(*meta["splits"]["train"])])
    ranges = {q: planar_range(q, v[train]) if planar else value_range(v[train]) for q, v in values.items()}
    layout = dataclasses.replace(find_layout(meta), position=tuple(names), velocity=tuple(names))
    rest = {key: value for key, value in meta.items() if key != "layout"}
    layout = {} if layout == LAYOUT else {"layout": layout.to_dict()}
    return rest | layout | {"normalization": meta["normalization"] | ranges}


def _check_output(root: Path, output: Path) -> None:
    if output.exists():
        raise ValueError(
            f"--output must be a new folder, got {output}, which exists; choose another or delete it"
        )
    if output.resolve().is_relative_to(root.resolve()):
        raise ValueError(f"--output must be outside of the dataset, got {output}; choose another")


def _check_method(method: str, window: int, order: int) -> None:
    if method not in METHODS:
        raise ValueError(f"--method must be one of {', '.join(METHODS)}, got {method!r}")
    if method == "savgol" and not (window % 2 and 2 <= order < window):
        raise ValueError(
            f"--window must be odd and --order at least 2 and below --window, got {window} and {order}"
        )
