"""Dynamics columns for datasets without them: positions of a state or of the frames, and their derivatives."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from dynmap_rl.envs.task import BODIES, LAYOUT
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.keys import DYNAMICS, FOUND

from .angles import align_axes, align_turns
from .camera import FrameSource, choose_view, read_motion
from .decoding import entry_kinds
from .demonstrations import DERIVED, META, find_layout, find_meta
from .derivatives import check_method, differentiate, is_uniform
from .format.columns import new_folder, write_columns
from .format.reading import find_dataset, read_column, read_info, read_table, spans
from .motion import Motion
from .normalization import planar_range, value_range
from .quality import Derived, judge_quality
from .state import choose_state, read_state

SOURCES = "state", "centroid", "tracks", "flow", "state,tracks", "state,flow"


def add_dynamics(
    dataset: str | Path,
    output: str | Path | None = None,
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
    preview: int | None = None,
) -> dict:
    """Copy a LeRobot v3.0 dataset and add the columns ``dynamics.position``, ``.velocity`` and ``.acceleration``.

    The columns (float32) are computed for one episode at a time, in float64, with the times of the column ``timestamp``.
    From frames there is also ``dynamics.found`` (bool): whether what an entry belongs to was found in the frame. Other
    positions are interpolated, and trainings leave these entries out. The new folder appears when it is complete. Videos
    and all other files are copied. A recording of a task stays one, and can be trained on with the recipes of the tasks: its
    constants of normalisation and the names of its dynamics are written anew.
    ``meta/dynamics.json`` has all settings, and the quality of the columns.

    Args:
        dataset: local folder or hub id.
        output: the new folder; None with ``preview``.
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
        method: ``central`` or ``savgol`` (see :func:`dynmap_rl.data.differentiate`); by default central for a state, savgol
            for frames.
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
        preview: number of episodes, the first ones, that are derived and judged without writing a dataset; by default all
            episodes are, and the dataset is written.

    Returns:
        ``differences``, the mean absolute difference from replaced columns, ``[D]`` by quantity; ``quality`` (see
        :func:`dynmap_rl.data.quality.judge_quality`); ``view``, the camera with all defaults, None for a state;
        ``names``, those of the entries of the last source; and ``episodes``, their number.

    Raises:
        ValueError: an argument is wrong, or the dataset is damaged or does not allow it.
        OSError: the folder cannot be written.
    """
    if (output is None) == (preview is None):
        raise ValueError(
            "one of --output and --preview must be given: the folder of the new dataset, or a number of episodes"
        )
    if preview is not None and preview < 1:
        raise ValueError(f"--preview must be at least 1 episode, got {preview}")
    root = find_dataset(dataset)
    info, meta = read_info(root), find_meta(root)
    old = [name for q in DYNAMICS if (name := f"dynamics.{q}") in info["features"]]
    if old and not replace and preview is None:
        raise ValueError(f"{root} must not have {', '.join(old)}; replace them with --replace")
    if output is not None:
        output = _check_output(root, Path(output).expanduser())
    if source not in SOURCES:
        raise ValueError(f"--source must be one of {', '.join(map(repr, SOURCES))}, got {source!r}")
    check_method(method or ("central" if source == "state" else "savgol"), window, order)
    table = read_table(root, info, ["timestamp", *old])
    rows = dict(islice(spans(table["episode_index"].to_numpy()), preview))
    end = max(own.stop for own in rows.values())
    time = read_column(root, info, table, "timestamp", np.float64).numpy()[:end, 0]
    planar = meta is not None and _is_planar(meta)
    parts, entries, view = [], None, None  # names, motions by episode, and method
    if "state" in source:
        entries = choose_state(info, state, columns, angles, period, noise, angle_noise, noise_seed)
        motions = islice(read_state(root, info, entries), preview)
        parts.append((entries.names, motions, method or "central"))
    if source != "state":
        frames = {"camera": camera, "objects": objects, "colors": colors, "threshold": threshold}
        frames |= {"sort": sort, "point": point, "width": width}
        view = choose_view(root, info, source.removeprefix("state,"), planar, **frames)
        parts.append((view.names, read_motion(root, info, view, preview and list(rows)), method or "savgol"))
    names = [name for part in parts for name in part[0]]
    ordered = view and view.sort == "lowest" and not view.colors  # the cart is below the block
    if planar and ordered and view.names == FrameSource("tracks", "", len(BODIES) // 3).names == names:
        names = list(BODIES)
        parts = [(names, *parts[0][1:])]
    if len(set(names)) < len(names):
        raise ValueError(
            f"names of the dynamics must be different, got {', '.join(names)}; take other --columns"
        )
    _check_times(root, time, rows, [part[2] for part in parts], window)
    with new_folder(output) if output else contextlib.nullcontext() as folder:
        values, seen, derived = _derive_parts(root, parts, time, rows, window, order)
        differences = {}
        for name in old:
            quantity = name.removeprefix("dynamics.")
            with contextlib.suppress(ValueError):  # damaged columns may be replaced too
                before = read_column(root, info, table, name, np.float64).numpy()[:end]
                if before.shape == values[quantity].shape:
                    differences[quantity] = np.abs(values[quantity] - before).mean(0)
        quality = judge_quality(derived)
        found = {"differences": differences, "quality": quality, "view": view, "names": parts[-1][0]}
        found["episodes"] = len(rows)
        if not folder:
            return found
        new = {f"dynamics.{q}": v.astype(np.float32) for q, v in values.items()}
        if view or FOUND in info["features"]:
            new[FOUND] = seen
        how = {"source": source, "methods": [part[2] for part in parts], "window": window, "order": order}
        how |= {"state": entries and dataclasses.asdict(entries), "frames": view and dataclasses.asdict(view)}
        how |= quality | {"differences": {q: d.tolist() for q, d in differences.items()}}
        meta = _describe(meta, planar, names, values, rows) if meta else None
        write_columns(root, folder, info, table, new, names, {META: meta, DERIVED: how})
    return found


def _derive_parts(
    root: Path, parts: list, time: np.ndarray, rows: dict[int, slice], window: int, order: int
) -> tuple[dict[str, np.ndarray], np.ndarray, list[Derived]]:
    """Return the values ``[N, D]`` by quantity, whether they were found, and what is judged.

    Args:
        root: folder of the dataset, for messages.
        parts: names of the entries, motions by episode, and method of every source.
        time: timestamps ``[N]``.
        rows: rows of every episode.
        window: see :func:`dynmap_rl.data.differentiate`.
        order: see :func:`dynmap_rl.data.differentiate`.
    """
    shape = len(time), sum(len(names) for names, _, _ in parts)
    values, seen = {quantity: np.empty(shape) for quantity in DYNAMICS}, np.ones(shape, dtype=bool)
    derived, start = [], 0
    for names, motions, method in parts:
        own, first = slice(start, start := start + len(names)), len(derived)
        for episode, motion in motions:
            try:
                found, motion = _derive(motion, time[rows[episode]], method, window, order)
            except ValueError as error:
                raise ValueError(f"{root}: episode {episode}: {error}") from error
            for quantity, part in found.items():
                values[quantity][rows[episode], own] = part
            if motion.found is not None:
                seen[rows[episode], own] = motion.found.repeat(len(names) // motion.found.shape[1], 1)
            derived.append(Derived(episode, names, found["position"], found["velocity"], motion))
        angle = values["position"][:, own][:, motion.angles]
        if motion.tracks:
            align_axes(angle, [(rows[part.episode], part.motion) for part in derived[first:]])
        else:
            align_turns(angle, list(rows.values()), motion.period)
        values["position"][:, own][:, motion.angles] = angle
    return values, seen, derived


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


def _check_times(
    root: Path, time: np.ndarray, rows: dict[int, slice], methods: list[str], window: int
) -> None:
    needed = window if "savgol" in methods else 3
    lengths = {episode: own.stop - own.start for episode, own in rows.items()}
    if short := [f"{episode} ({length} steps)" for episode, length in lengths.items() if length < needed]:
        shorter = "use --method central or a shorter --window, or " if needed > 3 else ""
        raise ValueError(
            f"{root} must have at least {needed} steps in every episode, got fewer in {', '.join(short)}; {shorter}delete "
            "these episodes (lerobot-edit-dataset)"
        )
    if unordered := [str(episode) for episode, own in rows.items() if (np.diff(time[own]) <= 0).any()]:
        raise ValueError(
            f"{root} must have timestamps that increase, got others in the episodes {', '.join(unordered)}; delete these "
            "(lerobot-edit-dataset), or correct the column timestamp"
        )
    uneven = [str(episode) for episode, own in rows.items() if not is_uniform(time[own])]
    if uneven and "savgol" in methods:
        raise ValueError(
            f"{root} must have uniform timestamps for --method savgol, got others in the episodes {', '.join(uneven)}; use "
            "--method central"
        )


def _is_planar(meta: dict) -> bool:
    """Return whether the task of a recording is in the plane.

    A dataset must not run code: a task whose module is not imported is in the plane if it has the states of cart and block.
    """
    try:
        return get_task(meta["task"], from_file=True).planar
    except ValueError:
        layout = find_layout(meta)
        return dataclasses.replace(layout, position=LAYOUT.position, velocity=LAYOUT.velocity) == LAYOUT


def _describe(
    meta: dict, planar: bool, names: list[str], values: dict[str, np.ndarray], rows: dict[int, slice]
) -> dict | None:
    """Return the metadata of a recording with other dynamics; None where the recipes of its task cannot read them."""
    if planar and entry_kinds(names) != np.resize(["x", "y", "theta"], len(names)).tolist():
        return None
    train = np.concatenate([np.arange(rows[e].start, rows[e].stop) for e in range(*meta["splits"]["train"])])
    ranges = {q: planar_range(q, v[train]) if planar else value_range(v[train]) for q, v in values.items()}
    layout = dataclasses.replace(find_layout(meta), position=tuple(names), velocity=tuple(names))
    rest = {key: value for key, value in meta.items() if key != "layout"}
    layout = {} if layout == LAYOUT else {"layout": layout.to_dict()}
    return rest | layout | {"normalization": meta["normalization"] | ranges}


def _check_output(root: Path, output: Path) -> Path:
    """Return the folder, which must be new and outside of the dataset."""
    if output.exists():
        raise ValueError(
            f"--output must be a new folder, got {output}, which exists; choose another or delete it"
        )
    if output.resolve().is_relative_to(root.resolve()):
        raise ValueError(f"--output must be outside of the dataset, got {output}; choose another")
    return output
