"""LeRobot v3.0 datasets as they lie in a folder: where it is, its metadata, its columns and images."""

from __future__ import annotations

import io
import json
import math
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from PIL import Image

from dynmap_rl.utils.files import check_form
from dynmap_rl.utils.hub import first_line, is_hub_id

LEROBOT_VERSION = "v3.0"
INFO = {"total_frames": int, "features": {str: {"dtype": str, "shape": [int]}}}
PNG = b"\x89PNG\r\n\x1a\n"


def find_dataset(dataset: str | Path) -> Path:
    """The local folder of a dataset; one named by a hub id is downloaded, or found in LeRobot's cache when offline.

    Raises:
        ValueError: there is neither such a folder nor such a dataset on the hub.
    """
    folder = Path(dataset).expanduser()
    if folder.is_dir():
        return folder
    if not is_hub_id(dataset, "datasets"):
        raise ValueError(f"no dataset at {dataset}; record one with recipes/collect.py --output {dataset}")
    from httpx import HTTPError
    from huggingface_hub import snapshot_download
    from lerobot.utils.constants import HF_LEROBOT_HUB_CACHE

    try:
        return Path(
            snapshot_download(
                dataset, repo_type="dataset", revision=LEROBOT_VERSION, cache_dir=HF_LEROBOT_HUB_CACHE
            )
        )
    except (
        OSError,
        ValueError,
        HTTPError,
    ) as error:  # every error of the hub's client, or of the network below it
        reason = first_line(error)
        raise ValueError(
            f"no dataset at {dataset}, neither as a folder nor with the tag {LEROBOT_VERSION} on the hub ({reason}); "
            "check the name and the network, or record one with recipes/collect.py"
        ) from error


def read_metadata(path: Path, form=dict) -> dict:
    """A JSON file of a dataset, which has a form (see :func:`dynmap_rl.runs.check_form`).

    Raises:
        ValueError: it is damaged, not there, or of another form.
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
    """``meta/info.json``: features, splits, numbers of episodes and frames.

    Raises:
        ValueError: the folder is no LeRobot dataset, or one of another version.
    """
    path = root / "meta" / "info.json"
    if not path.exists():
        raise ValueError(
            f"{root} is not a LeRobot dataset (no meta/info.json); record one with recipes/collect.py"
        )
    info = read_metadata(path)
    if (version := info.get("codebase_version")) != LEROBOT_VERSION:
        raise ValueError(
            f"{root} is of LeRobot's format {version}, not {LEROBOT_VERSION}; convert it with LeRobot's script"
        )
    check_form(info, INFO, str(path))
    check_form(info.get("splits") or {}, {str: str}, f"{path}, splits")
    return info


def read_split(root: Path, info: dict, name: str) -> range:
    """The episodes of a split.

    Raises:
        ValueError: the dataset does not name it, or not as ``FIRST:END``.
    """
    if name not in (splits := info.get("splits") or {}):
        raise ValueError(f"{root} has no split {name!r}; choose from {sorted(splits)}")
    try:
        first, end = map(int, splits[name].split(":"))
    except ValueError as error:
        raise ValueError(
            f"{root} has a split {name} {splits[name]!r}, not FIRST:END; restore its meta/info.json"
        ) from error
    return range(first, end)


def read_file(file: Path, columns: list[str]) -> pa.Table:
    """Columns of one parquet file.

    Raises:
        ValueError: it is damaged, lacks a column (which PyArrow leaves out without a word), or counts by other than
            whole numbers.
    """
    try:
        table = pq.ParquetFile(file).read(columns)
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{file} is a damaged or unfinished data file ({error}); restore it or record the dataset again"
        ) from error
    if missing := [name for name in columns if name not in table.column_names]:
        raise ValueError(
            f"{file} lacks the columns {', '.join(missing)}; restore it or record the dataset again"
        )
    for name in {"index", "episode_index"} & {*columns}:
        if not pa.types.is_integer(table.schema.field(name).type) or table[name].null_count:
            raise ValueError(f"{file} has no whole numbers in {name}; restore it or record the dataset again")
    return table


def read_table(root: Path, info: dict, columns: list[str]) -> pa.Table:
    """These columns of all data files, and ``index`` and ``episode_index``, in order of time.

    Raises:
        ValueError: a file is damaged, or columns or frames are missing.
    """
    files = sorted((root / "data").glob("*/*.parquet"))
    tables = [read_file(file, ["index", "episode_index", *columns]) for file in files]
    try:
        table = pa.concat_tables(tables) if tables else []
    except pa.ArrowException as error:
        raise ValueError(f"{root} has data files of different columns ({error}); record it again") from error
    if not len(table) or len(table) != info["total_frames"]:
        raise ValueError(
            f"{root} is incomplete: {len(table)} of {info['total_frames']} frames; restore it or record it again"
        )
    return table.sort_by("index")


def read_column(root: Path, info: dict, table: pa.Table, name: str, dtype=np.float32) -> torch.Tensor:
    """A column's numbers ``[N, D]`` as memory of their own.

    Raises:
        ValueError: some are missing or not finite, or there are not as many as ``meta/info.json`` says.
    """
    flat = table[name].combine_chunks()
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    values = flat.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "biuf" or table[name].null_count or not np.isfinite(values).all():
        raise ValueError(f"{root} has numbers in {name} that are missing or not finite; record it again")
    size = math.prod(info["features"][name]["shape"]) if name in info["features"] else 1
    if len(values) != size * len(table):
        raise ValueError(f"{root} does not have {size} numbers in every row of {name}; record it again")
    return torch.from_numpy(values.astype(bool if values.dtype == bool else dtype)).reshape(-1, size)


def image_files(where: Path, name: str, column: pa.ChunkedArray) -> pa.Array:
    """The image files in a camera's column, which is of the dataset or the file ``where``.

    Raises:
        ValueError: it holds no files.
    """
    array = column.combine_chunks()
    try:
        files = array.field("bytes")
    except (AttributeError, KeyError):
        files = None
    if files is None or not pa.types.is_binary(files.type):
        raise ValueError(f"{where} holds no image files in {name}; restore it or record it again")
    return files


def spans(episode: np.ndarray) -> list[tuple[int, slice]]:
    """Each episode's index, and its rows."""
    borders = [0, *(np.flatnonzero(np.diff(episode)) + 1).tolist(), len(episode)]
    return [(int(episode[a]), slice(a, b)) for a, b in pairwise(borders)]


def decode_image(file: pa.Buffer | None, largest: int) -> np.ndarray:
    """An image file's uint8 ``[height, width, 3]`` (RGB).

    Raises:
        ValueError: it cannot be decoded, or has more pixels than ``largest``: a small file can hold a huge picture.
    """
    data = np.frombuffer(file or b"", np.uint8)
    try:
        if data[:8].tobytes() == PNG and data.size >= 24:
            width, height = data[16:24].view(">u4").tolist()
        else:  # which takes as long as decoding a small PNG
            width, height = Image.open(io.BytesIO(data)).size
    except (OSError, Image.DecompressionBombError) as error:
        raise ValueError("cannot be decoded") from error
    if width * height > largest:
        raise ValueError(f"has {width} x {height} pixels, more than the dataset says")
    frame = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    if frame is None:
        raise ValueError("cannot be decoded")
    return frame
