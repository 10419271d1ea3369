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

from dynmap_rl.keys import CAMERA, FRAME_SHAPE, NEEDED, OPTIONAL

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
SIZES = {"observation.state": 5, "action": 3, **{NEEDED[key]: 6 for key in NEEDED if "dynamics" in key}}
SIZES |= dict.fromkeys(OPTIONAL.values(), 1) | {"expert_action": 3}


def load_dataset(dataset: str | Path, split: str | None = None) -> TensorDict:
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

    Returns:
        ``[E, T]`` in SI units, numbers as float32, flags as bool:

        - ``pixels`` uint8 ``[E, T, 3, 64, 64]``, ``agent_pos`` ``[E, T, 5]``, ``goal`` ``[E, T, 2]`` (the last two
          entries of ``agent_pos``), ``action`` ``[E, T, 3]``
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
    info = read_info(root)
    find_meta(root)
    columns = _choose_columns(root, info)
    table = read_table(root, info, [CAMERA, *columns.values()])
    if split is not None:
        table = _select_episodes(table, read_split(root, info, split))
    return _build_episodes(root, info, table, columns)


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
    columns = _choose_columns(root, info)
    table = read_table(root, info, [CAMERA, *columns.values()])
    splits = choose_splits(root, info, np.unique(table["episode_index"].to_numpy()).tolist())
    episodes = {
        name: _build_episodes(root, info, _select_episodes(table, members), columns)
        for name, members in splits.items()
    }
    return episodes, meta["normalization"] if meta else normalization_constants(episodes["train"])


def load_meta(dataset: str | Path) -> dict:
    """Load what a recording says beside its columns.

    Args:
        dataset: local folder or hub id.

    Returns:
        ``format``, ``task``, ``expert``, ``kind``, ``splits`` (name to first episode and the one after the last),
        ``normalization`` (see :func:`dynmap_rl.data.normalization_constants`), and ``episodes``, a dict for each:
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


def _choose_columns(root: Path, info: dict) -> dict:
    """Return the columns to load, by key."""
    features = info["features"]
    if missing := [name for name in (CAMERA, *NEEDED.values()) if name not in features]:
        raise ValueError(
            f"{root} must have the columns {', '.join(missing)}; add or rename them (dynamics.* are positions, "
            "velocities and accelerations), or record a dataset with recipes/collect.py"
        )
    if (dtype := features[CAMERA]["dtype"]) != "image":
        raise ValueError(f"{CAMERA} of {root} must be image, got {dtype}; record it with use_videos=False")
    if (shape := tuple(features[CAMERA]["shape"])) != FRAME_SHAPE:
        raise ValueError(
            f"{CAMERA} of {root} must have the shape {FRAME_SHAPE}, got {shape}; resize the frames"
        )
    for name, size in SIZES.items():
        if name in features and (shape := tuple(features[name]["shape"])) != (size,):
            raise ValueError(
                f"{name} of {root} must have the shape ({size},), got {shape}; train on other datasets with "
                "recipes/robot.py"
            )
    return NEEDED | {key: name for key, name in OPTIONAL.items() if name in features}


def _select_episodes(table: pa.Table, members: range | list[int]) -> pa.Table:
    return table.filter(pa.array(np.isin(table["episode_index"].to_numpy(), members)))


def _build_episodes(root: Path, info: dict, table: pa.Table, columns: dict) -> TensorDict:
    count, steps = shape = _episodes_and_steps(root, table)
    data = {key: read_column(root, info, table, name).unflatten(0, shape) for key, name in columns.items()}
    data["goal"] = data["agent_pos"][..., -2:].clone()
    data["pixels"] = _decode_frames(root, table[CAMERA]).unflatten(0, shape)
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


def _decode_frames(root: Path, column: pa.ChunkedArray) -> torch.Tensor:
    """Decode PNG files to uint8 ``[N, 3, 64, 64]`` in threads: the decoder releases the interpreter's lock."""
    files = image_files(root, CAMERA, column)
    height, width, channels = FRAME_SHAPE
    pixels = np.empty((len(files), channels, height, width), dtype=np.uint8)

    def decode(rows: range) -> None:
        frames = np.empty((len(rows), *FRAME_SHAPE), dtype=np.uint8)
        for i, row in enumerate(rows):
            try:
                frame = decode_image(files[row].as_buffer(), height * width)
                if frame.shape != FRAME_SHAPE:
                    raise ValueError(f"must have the shape {FRAME_SHAPE}, got {frame.shape}")
            except ValueError as error:
                raise ValueError(
                    f"{root}: frame {row} {error}; restore the dataset or record it again"
                ) from error
            frames[i] = frame
        pixels[rows.start : rows.stop] = frames.transpose(0, 3, 1, 2)  # all at once: a sixth less time

    blocks = [range(i, min(i + 500, len(files))) for i in range(0, len(files), 500)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(decode, blocks))
    return torch.from_numpy(pixels)
