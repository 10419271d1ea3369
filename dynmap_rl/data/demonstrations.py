"""Demonstrations of the tasks: LeRobot datasets with dynamics columns as one TensorDict ``[episode, time]``.

The parquet files are read column by column, some ten times faster than frame by frame. LeRobot is not imported: its
import is slow, it creates folders for missing datasets, and it asks the network about damaged ones.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from numbers import Real
from pathlib import Path

import numpy as np
import pyarrow as pa
import torch
from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.keys import CAMERAS, NEEDED, OPTIONAL
from dynmap_rl.utils.files import check_form

from .format.reading import (
    choose_splits,
    decode_image,
    find_dataset,
    image_files,
    read_column,
    read_info,
    read_metadata,
    read_split,
    read_table,
)
from .normalization import normalization_constants

FORMAT = 4  # version of what is recorded, and how
META = "meta/dynmap.json"
RANGE = {"low": [Real], "high": [Real]}
META_FORM = {
    "format": int,
    "task": str,
    "kind": str,
    "splits": {"train": [int], "eval": [int]},
    "normalization": dict.fromkeys(("action", "goal", "position", "velocity", "acceleration"), RANGE),
    "episodes": [{"episode_index": int}],
}
NAMES, NUMBERS = ("action", "state", "position", "velocity", "cameras"), ("steps", "fps", "image_size")
LAYOUT_FORM = {
    **{name: [str] for name in NAMES},
    **{name: int for name in NUMBERS},
    "action_limit": [Real],
    "robot": str,
}


def load_dataset(dataset: str | Path, split: str | None = None, layout: Layout | None = None) -> TensorDict:
    """Load all episodes of a LeRobot v3.0 dataset, or the episodes of a split, into memory.

    The result has TorchRL's episode data format (TED): observations and action of step t at the root, what follows the
    action under ``next``. Observations are not repeated under ``next``;
    ``torchrl.envs.transforms.NextStateReconstructor`` adds the next observations of a sample.

    A row of the result is one trajectory: ``("next", "done")`` and ``("next", "truncated")`` are true at its last step
    only, and ``terminated`` is never true. Recordings run to the time limit, also after a failure, so that the column
    ``next.done`` of an exploration can be true earlier.

    Args:
        dataset: local folder, or id of a dataset on the Hugging Face hub (``user/name``).
        split: ``train``, ``eval``, or another split that the dataset's ``info.json`` names.
        layout: sizes and names of the task; by default those that the recording names, otherwise those of the tasks of
            cart and block.

    Returns:
        ``[E, T]`` in SI units, numbers as float32, flags as bool. Sizes are those of the layout; of cart and block:

        - ``pixels`` uint8 ``[E, T, 3, 64, 64]`` (frames of several cameras side by side), ``agent_pos`` ``[E, T, 5]``,
          ``goal`` ``[E, T, 2]`` (the last entries of ``agent_pos``), ``action`` ``[E, T, 3]``
        - ``("dynamics", "position" | "velocity" | "acceleration")`` ``[E, T, 6]``
        - ``expert_action`` ``[E, T, 3]``, where the dataset has it: what the expert would have done, without noise and
          pushes; imitation learns it
        - ``disturbed`` ``[E, T, 1]``: a push acted in the place of the expert; false without such a column
        - ``("next", "reward" | "is_success")`` ``[E, T, 1]``, where the dataset has the columns ``next.reward`` and
          ``next.success``
        - ``done``, ``terminated``, ``truncated`` ``[E, T, 1]``, at the root and under ``next``
        - ``episode`` int64 ``[E, T]``, the index in the dataset, by which TorchRL's ``SliceSampler`` tells episodes apart,
          and ``step_count`` int64 ``[E, T, 1]``, the number of the step

    Raises:
        ValueError: the dataset is missing, damaged, or has another form.
    """
    root = find_dataset(dataset)
    info, meta = read_info(root), find_meta(root)
    layout = layout or find_layout(meta)
    columns = _choose_columns(root, info, layout)
    table = read_table(root, info, [*_cameras(layout), *columns.values()])
    if split is not None:
        table = _select_episodes(table, read_split(root, info, split))
    return _build_episodes(root, info, table, columns, layout)


def load_demonstrations(dataset: str | Path) -> tuple[dict[str, TensorDict], dict]:
    """Load training and held-out episodes, with the constants of normalisation.

    A dataset without ``meta/dynmap.json``, such as one that LeRobot's tools have edited, is accepted: its constants are
    computed from its training episodes. Without splits ``train`` and ``eval``, every tenth episode is held out, or the
    last one of fewer than ten.

    Args:
        dataset: local folder or hub id.

    Returns:
        The episodes by split, ``train`` and ``eval`` (see :func:`load_dataset`), and the constants (see
        :func:`dynmap_rl.data.normalization_constants`).

    Raises:
        ValueError: the dataset is missing, damaged, has another form, or fewer than two episodes.
    """
    root = find_dataset(dataset)
    info = read_info(root)
    meta = find_meta(root)
    layout = find_layout(meta)
    columns = _choose_columns(root, info, layout)
    table = read_table(root, info, [*_cameras(layout), *columns.values()])
    splits = choose_splits(root, info, np.unique(table["episode_index"].to_numpy()).tolist())
    episodes = {
        name: _build_episodes(root, info, _select_episodes(table, members), columns, layout)
        for name, members in splits.items()
    }
    return episodes, meta["normalization"] if meta else normalization_constants(episodes["train"])


def load_meta(dataset: str | Path) -> dict:
    """Load what a recording says beside its columns.

    Args:
        dataset: local folder or hub id.

    Returns:
        ``format``, ``task``, ``layout`` (except of cart and block), ``expert``, ``kind``, ``splits`` (name to first
        episode and the one after the last), ``normalization`` (see :func:`dynmap_rl.data.normalization_constants`), and
        ``episodes``, a dict for each:
        ``episode_index``, ``split``, ``scene_seed``, ``checkpoint``, ``noise``, ``detours``, ``pushes``, ``scene``,
        ``success``, ``dropped``, ``position_error`` (m).

    Raises:
        ValueError: the dataset is missing, or is not a recording of this release.
    """
    root = find_dataset(dataset)
    if (meta := find_meta(root)) is None:
        read_info(root)
        raise ValueError(
            f"{dataset} must be a recording with {META}, got a dataset without it; record one with "
            "recipes/collect.py, or train on this one with recipes/robot.py"
        )
    return meta


def find_meta(root: Path) -> dict | None:
    """Read ``meta/dynmap.json`` of the dataset in a folder; None where it is missing.

    Raises:
        ValueError: the file is damaged, or of another release.
    """
    if not (root / META).exists():
        return None
    meta = read_metadata(root / META)
    if (version := meta.get("format")) != FORMAT:
        raise ValueError(
            f"{root} must be a recording of format {FORMAT}, got format {version}; record it again with "
            "recipes/collect.py"
        )
    return read_metadata(root / META, META_FORM)


def find_layout(meta: dict | None) -> Layout:
    """Return the layout of a recording; a recording of cart and block, and an edited dataset, name none.

    Args:
        meta: content of ``meta/dynmap.json``, or None.

    Raises:
        ValueError: the layout is damaged.
    """
    if meta is None or "layout" not in meta:
        return LAYOUT
    check_form(meta["layout"], LAYOUT_FORM, f"{META}, layout")
    return Layout.from_dict(meta["layout"])


def _cameras(layout: Layout) -> list[str]:
    return [f"{CAMERAS}{camera}" for camera in layout.cameras]


def _choose_columns(root: Path, info: dict, layout: Layout) -> dict:
    """Return the columns to load, by key."""
    features, cameras = info["features"], _cameras(layout)
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
    for name, size in sizes.items():
        if name in features and (shape := tuple(features[name]["shape"])) != (size,):
            raise ValueError(
                f"{name} of {root} must have the shape ({size},), got {shape}; train on other datasets with "
                "recipes/robot.py"
            )
    return NEEDED | {key: name for key, name in OPTIONAL.items() if name in features}


def _select_episodes(table: pa.Table, members: range | list[int]) -> pa.Table:
    return table.filter(pa.array(np.isin(table["episode_index"].to_numpy(), members)))


def _build_episodes(root: Path, info: dict, table: pa.Table, columns: dict, layout: Layout) -> TensorDict:
    count, steps = shape = _episodes_and_steps(root, table)
    data = {key: read_column(root, info, table, name).unflatten(0, shape) for key, name in columns.items()}
    data["goal"] = data["agent_pos"][..., -layout.goal_size :].clone()
    data["pixels"] = _decode_frames(root, table, layout).unflatten(0, shape)
    never = torch.zeros(*shape, 1, dtype=torch.bool)
    last = never.clone()
    last[:, -1] = True
    data["disturbed"] = data.get("disturbed", never).bool()
    for flag, value in (("done", last), ("terminated", never), ("truncated", last)):
        data[flag], data["next", flag] = never.clone(), value.clone()
    data["episode"] = torch.tensor(table["episode_index"].to_numpy()).reshape(shape)
    data["step_count"] = torch.arange(steps).repeat(count).reshape(count, steps, 1)
    return TensorDict(data, shape)


def _episodes_and_steps(root: Path, table: pa.Table) -> tuple[int, int]:
    _, lengths = np.unique(table["episode_index"].to_numpy(), return_counts=True)
    if not len(lengths) or lengths.min() != lengths.max():
        found = f"{lengths.min()} to {lengths.max()} steps" if len(lengths) else "no episode"
        raise ValueError(f"episodes of {root} must have equal lengths, got {found}; cut or remove some")
    return len(lengths), int(lengths[0])


def _decode_frames(root: Path, table: pa.Table, layout: Layout) -> torch.Tensor:
    """Decode PNG files to uint8 ``[N, 3, H, W]`` in threads: the decoder releases the interpreter's lock."""
    side, shape = layout.image_size, (layout.image_size, layout.image_size, 3)
    pixels = np.empty((len(table), *layout.frame_shape), dtype=np.uint8)

    def decode(rows: range, files: pa.Array, place: slice) -> None:
        frames = np.empty((len(rows), *shape), dtype=np.uint8)
        for i, row in enumerate(rows):
            try:
                frame = decode_image(files[row].as_buffer(), side * side)
                if frame.shape != shape:
                    raise ValueError(f"must have the shape {shape}, got {frame.shape}")
            except ValueError as error:
                raise ValueError(
                    f"{root}: frame {row} {error}; restore the dataset or record it again"
                ) from error
            frames[i] = frame
        # All at once: a sixth less time.
        pixels[rows.start : rows.stop, ..., place] = frames.transpose(0, 3, 1, 2)

    blocks = [range(i, min(i + 500, len(table))) for i in range(0, len(table), 500)]
    with ThreadPoolExecutor() as pool:
        for number, name in enumerate(_cameras(layout)):
            files, place = image_files(root, name, table[name]), slice(side * number, side * (number + 1))
            list(pool.map(lambda rows, files=files, place=place: decode(rows, files, place), blocks))
    return torch.from_numpy(pixels)
