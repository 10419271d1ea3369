"""Reading of LeRobot v3.0 datasets: finding the folder, metadata and columns."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from dynmap_rl.utils.files import check_form
from dynmap_rl.utils.hub import first_line, is_hub_id

LEROBOT_VERSION = "v3.0"
INFO = {"total_frames": int, "features": {str: {"dtype": str, "shape": [int]}}}


def find_dataset(dataset: str | Path) -> Path:
    """Return the local folder of a dataset.

    A dataset named by a hub id is first looked for in the folder that LeRobot records to (``HF_LEROBOT_HOME``), and then
    downloaded. Without a network it is found in LeRobot's cache.

    Args:
        dataset: local folder or hub id.

    Raises:
        ValueError: there is neither such a folder nor such a dataset on the hub.
    """
    folder = Path(dataset).expanduser()
    if folder.is_dir():
        return folder
    if not is_hub_id(dataset, "datasets"):
        raise ValueError(
            f"no dataset at {dataset}; check the path, or record the demonstrations of a task with recipes/collect.py "
            f"--output {dataset}"
        )
    from httpx import HTTPError
    from huggingface_hub import snapshot_download
    from lerobot.utils.constants import HF_LEROBOT_HOME, HF_LEROBOT_HUB_CACHE

    if ((folder := HF_LEROBOT_HOME / dataset) / "meta" / "info.json").exists():
        return folder
    place = {"repo_type": "dataset", "revision": LEROBOT_VERSION, "cache_dir": HF_LEROBOT_HUB_CACHE}
    try:
        return Path(snapshot_download(dataset, **place))
    except (
        OSError,
        ValueError,
        HTTPError,
    ) as error:  # all errors of the hub's client and of the network below it
        reason = first_line(error)
        raise ValueError(
            f"no dataset at {dataset}, neither as a folder, nor in {HF_LEROBOT_HOME}, nor with the tag {LEROBOT_VERSION} on "
            f"the hub ({reason}); check the name and the network, or record one with recipes/collect.py"
        ) from error


def read_metadata(path: Path, form=dict) -> dict:
    """Read a JSON file of a dataset.

    Args:
        path: the file.
        form: structure that the value must have (see :func:`dynmap_rl.utils.files.check_form`).

    Raises:
        ValueError: the file is missing, damaged, or of another structure.
    """
    try:
        value = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}); restore it or record the dataset again"
        ) from error
    check_form(value, form, str(path))
    return value


def read_info(root: Path) -> dict:
    """Read ``meta/info.json``: features, splits, numbers of episodes and frames.

    Raises:
        ValueError: the folder is not a LeRobot dataset, or a dataset of another version.
    """
    path = root / "meta" / "info.json"
    if not path.exists():
        raise ValueError(
            f"{root} must be a LeRobot dataset, got a folder without meta/info.json; check the path"
        )
    info = read_metadata(path)
    if (version := info.get("codebase_version")) != LEROBOT_VERSION:
        raise ValueError(
            f"{root} must be of LeRobot's format {LEROBOT_VERSION}, got {version}; one of v2.1 is converted by "
            "python -m lerobot.scripts.convert_dataset_v21_to_v30 (see its --help)"
        )
    check_form(info, INFO, str(path))
    check_form(info.get("splits") or {}, {str: str}, f"{path}, splits")
    return info


def read_split(root: Path, info: dict, name: str) -> range:
    """Return the episodes of a split.

    Raises:
        ValueError: the dataset does not name the split, or not as ``FIRST:END``.
    """
    if name not in (splits := info.get("splits") or {}):
        raise ValueError(f"split of {root} must be one of {sorted(splits)}, got {name!r}; choose another")
    try:
        first, end = map(int, splits[name].split(":"))
    except ValueError as error:
        raise ValueError(
            f"split {name} of {root} must be FIRST:END, got {splits[name]!r}; restore its meta/info.json"
        ) from error
    return range(first, end)


def choose_splits(
    root: Path, info: dict, episodes: list[int], usable: Container[int] | None = None
) -> dict[str, list[int]]:
    """Divide episodes into ``train`` and ``eval``.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``. Splits named there, ``train`` and ``eval``, ``test`` or ``val``, are
            kept; otherwise every tenth episode is held out, or the last usable one where there is none of these.
        episodes: indices of all episodes.
        usable: those that are kept, by default all.

    Raises:
        ValueError: there are fewer than two episodes, or splits are empty or share episodes.
    """
    named = info.get("splits") or {}
    kept = episodes if usable is None else [e for e in episodes if e in usable]
    held_out = next((name for name in ("eval", "test", "val") if name in named), None)
    if "train" in named and held_out:
        members = {"train": read_split(root, info, "train"), "eval": read_split(root, info, held_out)}
        if shared := sorted(set(members["train"]) & set(members["eval"])):
            raise ValueError(
                f"the splits train and {held_out} of {root} must not share episodes, got {shared[0]} to {shared[-1]} in "
                "both; correct meta/info.json"
            )
        splits = {name: [e for e in kept if e in members[name]] for name in members}
    else:
        held_out = [e for e in episodes[9::10] if e in kept] or kept[-1:]
        splits = {"train": [e for e in kept if e not in held_out], "eval": held_out}
    if len(episodes) < 2:
        raise ValueError(
            f"{root} must have at least two episodes, one to train on and one held out; record more"
        )
    if not all(splits.values()):
        found = ", ".join(f"{len(members)} in {name}" for name, members in splits.items())
        raise ValueError(
            f"{root} must have an episode of sufficient length in each of the splits train and eval, got {found}; use "
            "shorter windows, or record more episodes"
        )
    return splits


def read_file(file: Path, columns: list[str]) -> pa.Table:
    """Read columns of one parquet file.

    Raises:
        ValueError: the file is damaged, lacks a column (which PyArrow leaves out without an error), or has an index
            that is not a whole number.
    """
    try:
        table = pq.ParquetFile(file).read(columns)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{file} is a damaged or unfinished data file ({error}); restore it or record the dataset again"
        ) from error
    if missing := [name for name in columns if name not in table.column_names]:
        raise ValueError(
            f"{file} must have the columns {', '.join(missing)}; restore it or record the dataset again"
        )
    for name in {"index", "episode_index"} & {*columns}:
        if not pa.types.is_integer(table.schema.field(name).type) or table[name].null_count:
            raise ValueError(
                f"{name} of {file} must be whole numbers; restore it or record the dataset again"
            )
    return table


def iterate_tables(root: Path, columns: list[str]) -> Iterator[pa.Table]:
    """Read columns of one data file after the other, with ``index`` and ``episode_index``.

    Raises:
        ValueError: a file is damaged, or lacks a column.
    """
    for file in sorted((root / "data").glob("*/*.parquet")):
        yield read_file(file, ["index", "episode_index", *columns])


def read_table(root: Path, info: dict, columns: list[str], by_time: bool = True) -> pa.Table:
    """Read columns of all data files, with ``index`` and ``episode_index``, in order of time.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``.
        columns: names of the columns.
        by_time: sort by ``index``; otherwise the order is that of the files.

    Raises:
        ValueError: a file is damaged, columns or frames are missing, ``index`` does not number the frames, or the rows of an
            episode are apart.
    """
    tables = list(iterate_tables(root, columns))
    try:
        # LeRobot itself stores lists of fixed and of variable size in one dataset.
        table = pa.concat_tables(tables, promote_options="permissive") if tables else []
    except pa.ArrowException as error:
        raise ValueError(
            f"data files of {root} must have the same columns, got others ({error}); record it again"
        ) from error
    if not len(table) or len(table) != info["total_frames"]:
        raise ValueError(
            f"{root} must have {info['total_frames']} frames, got {len(table)}; restore it or record it again"
        )
    if not by_time:
        return table
    table = table.sort_by("index")
    if (wrong := table["index"].to_numpy() != np.arange(len(table))).any():
        raise ValueError(
            f"the column index of {root} must number all frames from 0, got {table['index'][int(wrong.argmax())]} for frame "
            f"{wrong.argmax()}; number them anew, in the order of episodes and time"
        )
    numbers = [episode for episode, _ in spans(table["episode_index"].to_numpy())]
    if len(numbers) > len(set(numbers)):
        raise ValueError(f"an episode of {root} must be one block of rows; number the episodes anew")
    return table


def read_column(
    root: Path, info: dict, table: pa.Table, name: str, dtype=np.float32, entries: list[int] | None = None
) -> torch.Tensor:
    """Copy the numbers of a column.

    Args:
        root: folder of the dataset, for messages.
        info: content of its ``meta/info.json``.
        table: rows of the dataset (see :func:`read_table`).
        name: the column.
        dtype: type of the result, except for columns of flags.
        entries: those that are read; by default all.

    Returns:
        ``[N, D]``, bool for a column of flags.

    Raises:
        ValueError: numbers are missing or not finite, or a row has not as many as ``meta/info.json`` says.
    """
    flat = table[name].combine_chunks()
    if isinstance(flat, pa.ExtensionArray):  # a matrix in each row, where the package datasets is imported
        flat = flat.storage
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    values = flat.to_numpy(zero_copy_only=False)
    size = math.prod(info["features"][name]["shape"]) if name in info["features"] else 1
    advice = "correct them, or delete the episode (lerobot-edit-dataset)"
    if values.dtype.kind not in "biuf" or table[name].null_count:
        raise ValueError(f"{name} of {root} must be finite numbers, got others; {advice}")
    if len(values) != size * len(table):
        raise ValueError(f"{name} of {root} must have {size} numbers in every row; record it again")
    values = values.reshape(-1, size)[:, slice(None) if entries is None else entries]
    if not (finite := np.isfinite(values).all(1)).all():
        row = int(finite.argmin())
        where = f"got {values[row].tolist()} in row {row}"
        if "episode_index" in table.column_names:
            where += f", episode {table['episode_index'][row]}"
        raise ValueError(f"{name} of {root} must be finite numbers, {where}; {advice}")
    return torch.from_numpy(values.astype(bool if values.dtype == bool else dtype))


def is_vector(feature: dict) -> bool:
    """Return whether a feature of ``meta/info.json`` is a column of numbers or flags."""
    return len(feature["shape"]) == 1 and feature["dtype"].startswith(("float", "int", "uint", "bool"))


def spans(episode: np.ndarray) -> list[tuple[int, slice]]:
    """Return the index of every episode and its rows."""
    borders = [0, *(np.flatnonzero(np.diff(episode)) + 1).tolist(), len(episode)]
    return [(int(episode[a]), slice(a, b)) for a, b in pairwise(borders)]
