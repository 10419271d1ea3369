"""Dynamics columns for datasets that have none: positions of a state or of the picture, differentiated."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from .demonstrations import META
from .format.columns import write_columns
from .format.frames import choose_camera, iterate_frames
from .format.reading import find_dataset, read_column, read_info, read_table, spans
from .tracking import WIDEST, track_centroid
from dynmap_rl.keys import DYNAMICS

METHODS = ("central", "savgol")


def differentiate(
    position: np.ndarray, time: np.ndarray, method: str = "central", window: int = 11, order: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and acceleration ``[T, D]`` of positions ``[T, D]`` at times ``[T]`` (s), float64.

    ``central``: differences over both neighbours, of second order at uneven times too (``numpy.gradient``), so that
    those of a parabola are exact; for the acceleration twice. ``savgol``: derivatives of a polynomial of ``order``
    that is fitted to ``window`` steps (Savitzky-Golay), for noisy positions at even times. Both look ahead: the results
    are labels, not what a policy could have seen.

    Raises:
        ValueError: too few steps, or times that do not increase or, for ``savgol``, are not uniform.
    """
    from scipy.signal import savgol_filter

    steps = np.diff(time)
    needed = window if method == "savgol" else 3
    if len(position) < needed:
        raise ValueError(f"has {len(position)} steps, and --method {method} needs {needed}")
    if not (steps > 0).all():
        raise ValueError("has timestamps that do not increase")
    if method == "central":
        velocity = np.gradient(position, time, axis=0, edge_order=2)
        return velocity, np.gradient(velocity, time, axis=0, edge_order=2)
    mean = (time[-1] - time[0]) / (len(time) - 1)
    # Timestamps are stored as float32, and are as uniform as that can say.
    if np.abs(steps - mean).max() > 0.01 * mean + 2 * np.spacing(np.float32(time[-1])):
        raise ValueError(
            f"has timestamps that are not uniform ({steps.min():.4g} to {steps.max():.4g} s apart); use --method central"
        )
    velocity, acceleration = (savgol_filter(position, window, order, k, mean, axis=0) for k in (1, 2))
    return velocity, acceleration


def add_dynamics(
    dataset: str | Path,
    output: str | Path,
    state: str = "observation.state",
    columns: Iterable[int] | None = None,
    angles: Iterable[int] = (),
    period: float = 2 * math.pi,
    method: str = "central",
    window: int = 11,
    order: int = 3,
    track: bool = False,
    camera: str | None = None,
    threshold: int = 30,
    replace: bool = False,
) -> dict[str, np.ndarray]:
    """Copy a LeRobot v3.0 dataset, and give it ``dynamics.position``, ``.velocity`` and ``.acceleration`` (float32).

    They are computed an episode at a time, in float64, with the times of the ``timestamp`` column. The new folder
    appears when it is whole. Videos are hard-linked where the file system can, all other files but the tables copied.

    Args:
        dataset: a folder or a hub id.
        output: the new folder.
        state: column whose entries are the positions; they stay as measured, but for unwrapped angles.
        columns: its entries, by default all.
        angles: those of them that are angles and jump by ``period`` (2 pi, or 360 for degrees).
        method, window, order: see :func:`differentiate`.
        track: take the positions from the frames of ``camera`` instead, with ``threshold``: see
            :func:`dynmap_rl.data.tracking.track_centroid`. They are in pixels of the camera's full frame.
        replace: put them in the place of columns that are there.

    Returns:
        Where columns were replaced, the mean absolute difference to these, ``[D]`` by quantity.

    Raises:
        ValueError: an argument is wrong, or the dataset is damaged or does not allow it.
        OSError: the folder cannot be written.
    """
    root, output = find_dataset(dataset), Path(output).expanduser()
    info = read_info(root)
    old = [name for q in DYNAMICS if (name := f"dynamics.{q}") in info["features"]]
    if old and not replace:
        raise ValueError(f"{root} has {', '.join(old)} already; --replace derives them anew")
    _check_output(root, output)
    _check_method(method, window, order)
    columns = _check_columns(root, info, state, columns, angles) if not track else None
    camera = choose_camera(root, info, camera) if track else None
    table = read_table(root, info, list({"timestamp", *old, *([] if track else [state])}))

    def read(name: str, dtype=np.float64) -> np.ndarray:
        return read_column(root, info, table, name, dtype).numpy()

    if track:
        names, angles, tracks = ["x", "y"], [], _track(root, info, camera, threshold)
    else:
        names = [entry_names(info, state)[i] for i in columns]
        position, angles = read(state)[:, columns], [columns.index(i) for i in angles]
    time = read("timestamp")[:, 0]
    values = {q: np.empty((len(table), len(names))) for q in DYNAMICS}
    for episode, rows in spans(table["episode_index"].to_numpy()):
        own = tracks[episode] if track else position[rows]
        own[:, angles] = np.unwrap(own[:, angles], axis=0, period=period)
        try:
            parts = own, *differentiate(own, time[rows], method, window, order)
        except ValueError as error:
            raise ValueError(f"{root}: episode {episode} {error}") from error
        for quantity, part in zip(DYNAMICS, parts, strict=True):
            values[quantity][rows] = part
    # A recording's constants and scenes say nothing of dynamics that are no longer those of cart and block.
    same = old and info["features"][old[0]]["shape"] == [len(names)]
    new = {f"dynamics.{q}": v.astype(np.float32) for q, v in values.items()}
    write_columns(root, output, info, table, new, names, without=() if same else (META,))
    there = {q: read(f"dynamics.{q}") for q in DYNAMICS if f"dynamics.{q}" in old}
    return {q: np.abs(values[q] - v).mean(0) for q, v in there.items() if v.shape == values[q].shape}


def parse_entries(text: str | None, option: str) -> list[int] | None:
    """``0,2`` as numbers; None as it is.

    Raises:
        ValueError: it is none such; the message begins with the option.
    """
    try:
        return None if text is None else [int(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} are whole numbers such as 0,1,2, not {text!r}") from error


def entry_names(info: dict, column: str) -> list[str]:
    """A name for every entry of a column: the dataset's own, or their numbers where it has none."""
    feature = info["features"][column]
    size, names = math.prod(feature["shape"]), feature.get("names")
    if isinstance(names, dict):  # by group, as in {"motors": [...]}
        names = [name for group in names.values() if isinstance(group, list) for name in group]
    named = isinstance(names, list) and len(names) == size
    return [str(name) for name in names] if named else [str(i) for i in range(size)]


def _check_output(root: Path, output: Path) -> None:
    if output.exists():
        raise ValueError(f"{output} exists; choose another --output or delete it")
    if output.resolve().is_relative_to(root.resolve()):
        raise ValueError(f"{output} is within the dataset; choose another --output")


def _check_method(method: str, window: int, order: int) -> None:
    if method not in METHODS:
        raise ValueError(f"--method is one of {', '.join(METHODS)}, not {method!r}")
    if method == "savgol" and not (window % 2 and 2 <= order < window):
        raise ValueError(
            f"savgol needs an odd --window and an --order of 2 to below it, not {window} and {order}"
        )


def _check_columns(root: Path, info: dict, state: str, columns, angles) -> list[int]:
    features = info["features"]
    if (
        state not in features
        or features[state]["dtype"] not in ("float32", "float64")
        or len(features[state]["shape"]) != 1
    ):
        vectors = [
            n for n, f in features.items() if f["dtype"] in ("float32", "float64") and len(f["shape"]) == 1
        ]
        raise ValueError(
            f"{root} has no column {state!r} of numbers; choose --state from {', '.join(vectors)}"
        )
    size = features[state]["shape"][0]
    columns = list(range(size) if columns is None else columns)
    if not columns or len(set(columns)) < len(columns) or not all(0 <= i < size for i in columns):
        raise ValueError(
            f"--columns are different ones of 0 to {size - 1}, the entries of {state}, not {columns}"
        )
    if unknown := [i for i in angles if i not in columns]:
        raise ValueError(f"--angles {unknown} are not among --columns {columns}")
    return columns


def _track(root: Path, info: dict, camera: str, threshold: int) -> dict[int, np.ndarray]:
    tracks = {}
    for episode, frames, factor in iterate_frames(root, info, camera, widest=WIDEST):
        try:
            tracks[episode] = (track_centroid(frames, threshold) + 0.5) * factor - 0.5
        except ValueError as error:
            raise ValueError(f"{root}: in episode {episode} {error}") from error
    return tracks
