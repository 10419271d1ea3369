"""Dynamics columns for datasets without them: positions of a state or of the frames, and their derivatives."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dynmap_rl.keys import DYNAMICS

from .demonstrations import META
from .format.columns import write_columns
from .format.frames import choose_camera, iterate_frames
from .format.reading import find_dataset, read_column, read_info, read_table, spans
from .tracking import WIDEST, track_centroid

METHODS = ("central", "savgol")


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
    """Copy a LeRobot v3.0 dataset and add the columns ``dynamics.position``, ``.velocity`` and ``.acceleration``.

    The columns (float32) are computed for one episode at a time, in float64, with the times of the column ``timestamp``.
    The new folder appears when it is complete. Videos are hard-linked where the file system can; all other files are
    copied.

    Args:
        dataset: local folder or hub id.
        output: the new folder.
        state: column whose entries are positions. They stay as measured, except for unwrapped angles.
        columns: entries of that column; by default all.
        angles: entries among ``columns`` that are angles and jump by ``period``.
        period: 2 pi for radians, 360 for degrees.
        method: ``central`` or ``savgol`` (see :func:`differentiate`).
        window: steps of the window of ``savgol``.
        order: order of the polynomial of ``savgol``.
        track: take positions from frames in place of ``state`` (see
            :func:`dynmap_rl.data.tracking.track_centroid`), in pixels of the camera's full frame.
        camera: column of these frames; by default the first camera.
        threshold: smallest difference of a colour channel of a pixel that moves.
        replace: replace existing dynamics columns.

    Returns:
        The mean absolute difference from replaced columns, ``[D]`` by quantity.

    Raises:
        ValueError: an argument is wrong, or the dataset is damaged or does not allow it.
        OSError: the folder cannot be written.
    """
    root, output = find_dataset(dataset), Path(output).expanduser()
    info = read_info(root)
    old = [name for q in DYNAMICS if (name := f"dynamics.{q}") in info["features"]]
    if old and not replace:
        raise ValueError(f"{root} must not have {', '.join(old)}; replace them with --replace")
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
    # Constants and scenes of a recording do not fit dynamics of other bodies.
    same = old and info["features"][old[0]]["shape"] == [len(names)]
    new = {f"dynamics.{q}": v.astype(np.float32) for q, v in values.items()}
    write_columns(root, output, info, table, new, names, without=() if same else (META,))
    there = {q: read(f"dynamics.{q}") for q in DYNAMICS if f"dynamics.{q}" in old}
    return {q: np.abs(values[q] - v).mean(0) for q, v in there.items() if v.shape == values[q].shape}


def parse_entries(text: str | None, option: str) -> list[int] | None:
    """Read a text such as ``0,2`` as numbers; None stays None.

    Args:
        text: the text.
        option: name of the option, for the message.

    Raises:
        ValueError: the text is not a list of whole numbers.
    """
    try:
        return None if text is None else [int(entry) for entry in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} must be whole numbers such as 0,1,2, got {text!r}") from error


def entry_names(info: dict, column: str) -> list[str]:
    """Return a name for every entry of a column: the dataset's own names, or numbers where it has none."""
    feature = info["features"][column]
    size, names = math.prod(feature["shape"]), feature.get("names")
    if isinstance(names, dict):  # by groups, as in {"motors": [...]}
        names = [name for group in names.values() if isinstance(group, list) for name in group]
    named = isinstance(names, list) and len(names) == size
    return [str(name) for name in names] if named else [str(i) for i in range(size)]


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


def _check_columns(root: Path, info: dict, state: str, columns, angles) -> list[int]:
    features = info["features"]
    numbers = ("float32", "float64")
    vectors = [n for n, f in features.items() if f["dtype"] in numbers and len(f["shape"]) == 1]
    if state not in vectors:
        raise ValueError(f"--state must be a column of numbers, one of {', '.join(vectors)}, got {state!r}")
    size = features[state]["shape"][0]
    columns = list(range(size) if columns is None else columns)
    if not columns or len(set(columns)) < len(columns) or not all(0 <= i < size for i in columns):
        raise ValueError(f"--columns must be different entries of {state}, 0 to {size - 1}, got {columns}")
    if unknown := [i for i in angles if i not in columns]:
        raise ValueError(f"--angles must be among --columns {columns}, got {unknown}")
    return columns


def _track(root: Path, info: dict, camera: str, threshold: int) -> dict[int, np.ndarray]:
    tracks = {}
    for episode, frames, factor in iterate_frames(root, info, camera, widest=WIDEST):
        try:
            tracks[episode] = (track_centroid(frames, threshold) + 0.5) * factor - 0.5
        except ValueError as error:
            raise ValueError(f"{root}: in episode {episode} {error}") from error
    return tracks
