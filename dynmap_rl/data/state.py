"""Positions in a column of numbers, such as a robot's own state."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .format.reading import is_vector, read_column, read_table, spans
from .motion import Motion


@dataclass(frozen=True)
class StateSource:
    """How a column is turned into positions.

    Attributes:
        column: the column.
        columns: its entries that are taken.
        names: their names.
        angles: indices into ``columns`` of the entries that are angles.
        period: period of the angles: 2 pi for radians, 360 for degrees.
        noise: standard deviation of normal noise that is added to the positions, for experiments, in their unit.
        angle_noise: likewise of the angles.
        seed: seed of the noise.
    """

    column: str
    columns: list[int]
    names: list[str]
    angles: list[int]
    period: float = 2 * math.pi
    noise: float = 0.0
    angle_noise: float = 0.0
    seed: int = 0


def choose_state(
    info: dict,
    column: str,
    columns: Iterable[int] | None = None,
    angles: Iterable[int] = (),
    period: float = 2 * math.pi,
    noise: float = 0.0,
    angle_noise: float = 0.0,
    seed: int = 0,
) -> StateSource:
    """Check the options of a state and return them as a :class:`StateSource`.

    Args:
        info: content of the dataset's ``meta/info.json``.
        column: the column.
        columns: entries to take; by default all.
        angles: entries among ``columns`` that are angles.
        period: period of the angles: 2 pi for radians, 360 for degrees.
        noise: noise of the positions.
        angle_noise: noise of the angles.
        seed: seed of the noise.

    Raises:
        ValueError: an argument is wrong.
    """
    if not (0 <= noise < math.inf and 0 <= angle_noise < math.inf):
        raise ValueError(f"--noise and --angle_noise must be at least 0, got {noise} and {angle_noise}")
    if not 0 < period < math.inf:
        raise ValueError(f"--period must be above 0, got {period}")
    vectors = [name for name, f in info["features"].items() if is_vector(f) and f["dtype"] != "bool"]
    if column not in vectors:
        raise ValueError(f"--state must be a column of numbers, one of {', '.join(vectors)}, got {column!r}")
    size = info["features"][column]["shape"][0]
    columns = list(map(int, range(size) if columns is None else columns))
    if not columns or len(set(columns)) < len(columns) or not all(0 <= i < size for i in columns):
        raise ValueError(f"--columns must be different entries of {column}, 0 to {size - 1}, got {columns}")
    angles = list(map(int, angles))
    if unknown := [i for i in angles if i not in columns]:
        raise ValueError(f"--angles must be among --columns {columns}, got {unknown}")
    names, places = entry_names(info, column), [columns.index(i) for i in angles]
    return StateSource(column, columns, [names[i] for i in columns], places, period, noise, angle_noise, seed)


def read_state(root: Path, info: dict, state: StateSource) -> Iterator[tuple[int, Motion]]:
    """Iterate over the episodes' positions in a column.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``.
        state: column and its settings.

    Raises:
        ValueError: a file is damaged.
    """
    table = read_table(root, info, [state.column])
    position = read_column(root, info, table, state.column, np.float64, state.columns).numpy()
    episodes = spans(table["episode_index"].to_numpy())
    spans_of = np.ptp(position[:, state.angles], axis=0)
    for entry, extent in zip(state.angles, spans_of, strict=True):
        if extent > 1.05 * state.period:
            raise ValueError(
                f"angle {state.names[entry]} of {state.column} must stay within --period {state.period:.4g}, but spans "
                f"{extent:.4g}; give --period 360 for degrees, and leave a continuous angle out of --angles"
            )
        steps = [np.abs(np.diff(position[own, entry])).max(initial=0) for _, own in episodes]
        if state.period > 4 * math.pi and extent < 1.05 * 2 * math.pi and max(steps) > math.pi:
            raise ValueError(
                f"angle {state.names[entry]} of {state.column} jumps by 2 pi, as radians do, got --period "
                f"{state.period:.4g}; leave out --period"
            )
    is_angle = np.isin(np.arange(len(state.columns)), state.angles)
    scale = np.where(is_angle, state.angle_noise, state.noise)
    position += scale * np.random.default_rng(state.seed).standard_normal(position.shape)
    for episode, rows in episodes:
        yield episode, Motion(position[rows], state.angles, state.period)


def entry_names(info: dict, column: str) -> list[str]:
    """Return a name for every entry of a column, all different.

    These are the dataset's own names: a list, a list for each group, as in ``{"motors": [...]}``, or the entry of each
    name, as in ``{"gripper": 6}``. Equal names are preceded by their group, or followed by their entry. A column without
    names has numbers.
    """
    feature = info["features"][column]
    size, names = math.prod(feature["shape"]), feature.get("names")
    if isinstance(names, dict):
        names = _ungroup(names, size)
    if not isinstance(names, list) or len(names) != size:
        return [str(i) for i in range(size)]
    names = [str(name) for name in names]
    names = [f"{name}_{i}" if names.count(name) > 1 else name for i, name in enumerate(names)]
    return names if len(set(names)) == size else [str(i) for i in range(size)]


def _ungroup(names: dict, size: int) -> list:
    """Return the names of groups, or of numbered entries, in order of the entries."""
    if sorted(map(str, names.values())) == sorted(map(str, range(size))):
        return sorted(names, key=lambda name: int(names[name]))
    grouped = [(group, str(name)) for group, own in names.items() if isinstance(own, list) for name in own]
    plain = [name for _, name in grouped]
    return [f"{group}_{name}" if plain.count(name) > 1 else name for group, name in grouped]
