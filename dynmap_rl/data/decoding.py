"""Episodes ``[E, T]`` from the columns of a LeRobot dataset, one data file after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.keys import CAMERAS, FOUND, NEEDED, OPTIONAL

from .format.images import decode_image, image_files
from .format.reading import iterate_tables, read_column, read_table

BLOCK = 500  # frames that a thread decodes at a time
FLAGS = "done", "terminated", "truncated"
BOOL = "disturbed", "labelled"
Key = str | tuple[str, str]
Allocate = Callable[[Key, tuple[int, ...], torch.dtype], torch.Tensor]


def decode_episodes(
    root: Path,
    info: dict,
    layout: Layout,
    order: Callable[[list[int]], Sequence[int]] = sorted,
    pixels: bool = True,
    allocate: Allocate | None = None,
) -> TensorDict:
    """Decode all episodes. Memory holds one data file at a time beside the result.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``.
        layout: sizes and names.
        order: function that orders the indices of the episodes.
        pixels: decode the frames; otherwise the result has no ``pixels``.
        allocate: function of key, shape and dtype that returns a tensor to be filled; by default in memory.

    Returns:
        ``[E, T]`` (see :func:`dynmap_rl.data.load_dataset`).

    Raises:
        ValueError: the dataset is damaged, or has another form.
    """
    columns = choose_columns(root, info, layout)
    episodes, rows = _place_rows(root, read_table(root, info, [], by_time=False), order)
    count, steps = shape = len(episodes), len(rows) // len(episodes)
    data: dict[Key, torch.Tensor] = {}

    def new(key: Key, size: Sequence[int], dtype: torch.dtype) -> torch.Tensor:
        """Return a tensor ``[E * T, *size]`` that is part of the result."""
        full = (*shape, *size)
        data[key] = allocate(key, full, dtype) if allocate else torch.empty(full, dtype=dtype)
        return data[key].flatten(0, 1)

    frames = new("pixels", layout.frame_shape, torch.uint8).numpy() if pixels else None
    values, start = {}, 0
    for table in iterate_tables(root, [*(camera_columns(layout) if pixels else []), *columns.values()]):
        place, start = rows[start : start + len(table)], start + len(table)
        for key, name in columns.items():
            part = read_column(root, info, table, name)
            if key not in values:
                values[key] = new(key, part.shape[1:], torch.bool if key in BOOL else part.dtype)
            values[key][torch.from_numpy(place)] = part.to(values[key].dtype)
        if pixels:
            _decode_frames(root, table, layout, frames, place)
    new("goal", [layout.goal_size], torch.float32)[:] = values["agent_pos"][:, -layout.goal_size :]
    if "disturbed" not in values:
        new("disturbed", [1], torch.bool).zero_()
    step = torch.arange(steps).repeat(count)
    for flag in FLAGS:
        new(flag, [1], torch.bool).zero_()
        new(("next", flag), [1], torch.bool)[:, 0] = (step == steps - 1) & (flag != "terminated")
    new("episode", [], torch.int64)[:] = torch.tensor(episodes).repeat_interleave(steps)
    new("step_count", [1], torch.int64)[:, 0] = step
    return TensorDict(data, shape)


def _place_rows(root: Path, table: pa.Table, order: Callable) -> tuple[list[int], np.ndarray]:
    """Return the ordered indices of the episodes, and the place of every row of the table in the result ``[E * T]``.

    Raises:
        ValueError: the lengths of the episodes differ.
    """
    index, episode = (table[name].to_numpy() for name in ("index", "episode_index"))
    found, lengths = np.unique(episode, return_counts=True)
    if lengths.min() != lengths.max():
        raise ValueError(
            f"episodes of {root} must have equal lengths, got {lengths.min()} to {lengths.max()} steps; cut or remove some"
        )
    ordered = np.array(order(found.tolist()))
    rank = np.empty(len(found), dtype=np.int64)
    rank[np.searchsorted(found, ordered)] = np.arange(len(ordered))
    rows = np.empty(len(index), dtype=np.int64)
    rows[np.lexsort((index, rank[np.searchsorted(found, episode)]))] = np.arange(len(index))
    return ordered.tolist(), rows


def camera_columns(layout: Layout) -> list[str]:
    """Return the names of the cameras' columns."""
    return [f"{CAMERAS}{camera}" for camera in layout.cameras]


def entry_kinds(names: Sequence[str]) -> list[str]:
    """Return what entries are, such as x, y and theta: augmentation changes each kind in its own way."""
    return [name.rpartition("_")[2] for name in names]


def choose_columns(root: Path, info: dict, layout: Layout) -> dict:
    """Return the columns to load, by key.

    Raises:
        ValueError: a column is missing or has another form.
    """
    features, cameras = info["features"], camera_columns(layout)
    if missing := [name for name in (*cameras, *NEEDED.values()) if name not in features]:
        raise ValueError(
            f"{root} must have the columns {', '.join(missing)}; add or rename them (dynamics.* are positions, "
            "velocities and accelerations), or record a dataset with recipes/collect.py"
        )
    expected = layout.image_size, layout.image_size, 3
    for name in cameras:
        if (dtype := features[name]["dtype"]) != "image":
            raise ValueError(f"{name} of {root} must be image, got {dtype}; record it with use_videos=False")
        if (shape := tuple(features[name]["shape"])) != expected:
            raise ValueError(
                f"{name} of {root} must have the shape {expected}, got {shape}; resize the frames"
            )
    sizes = dict.fromkeys(OPTIONAL.values(), 1) | {"expert_action": len(layout.action)}
    sizes |= {"observation.state": len(layout.state), "action": len(layout.action)}
    sizes |= {f"dynamics.{quantity}": len(names) for quantity, names in layout.dynamics.items()}
    sizes[FOUND] = len(layout.position)
    for name, size in sizes.items():
        if name in features and (shape := tuple(features[name]["shape"])) != (size,):
            raise ValueError(
                f"{name} of {root} must have the shape ({size},), got {shape}; train on other datasets with "
                "recipes/robot.py"
            )
    for quantity, names in layout.dynamics.items():
        found = features.get(f"dynamics.{quantity}", {}).get("names")
        if isinstance(found, list) and entry_kinds(found) != entry_kinds(names):
            raise ValueError(
                f"dynamics.{quantity} of {root} must have entries such as {', '.join(names)}, got {', '.join(found)}; "
                "train on other datasets with recipes/robot.py"
            )
    return NEEDED | {key: name for key, name in OPTIONAL.items() if name in features}


def _decode_frames(
    root: Path, table: pa.Table, layout: Layout, pixels: np.ndarray, place: np.ndarray
) -> None:
    """Decode PNG files in threads, as the decoder releases the interpreter's lock.

    Args:
        root: folder of the dataset, for messages.
        table: rows of one data file.
        layout: sizes and names.
        pixels: uint8 ``[E * T, 3, H, W]``, to be filled.
        place: place of every row in ``pixels``.
    """
    side, shape = layout.image_size, (layout.image_size, layout.image_size, 3)

    def decode(rows: range, files: pa.Array, part: slice) -> None:
        frames = np.empty((len(rows), *shape), dtype=np.uint8)
        for i, row in enumerate(rows):
            try:
                frame = decode_image(files[row].as_buffer(), side * side)
                if frame.shape != shape:
                    raise ValueError(f"must have the shape {shape}, got {frame.shape}")
            except ValueError as error:
                number = table["index"][row].as_py()
                raise ValueError(
                    f"{root}: frame {number} {error}; restore the dataset or record it again"
                ) from error
            frames[i] = frame
        # All at once: a sixth less time.
        pixels[place[rows.start : rows.stop], ..., part] = frames.transpose(0, 3, 1, 2)

    blocks = [range(i, min(i + BLOCK, len(table))) for i in range(0, len(table), BLOCK)]
    with ThreadPoolExecutor() as pool:
        for number, name in enumerate(camera_columns(layout)):
            files, part = image_files(root, name, table[name]), slice(side * number, side * (number + 1))
            list(pool.map(lambda rows, files=files, part=part: decode(rows, files, part), blocks))
