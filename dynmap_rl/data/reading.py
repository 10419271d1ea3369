"""LeRobot v3.0 datasets as they lie in a folder: where it is, its metadata, its columns and images."""

from __future__ import annotations

import io
import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from PIL import Image

from dynmap_rl.hub import first_line, is_hub_id

LEROBOT_VERSION = "v3.0"
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


def read_metadata(path: Path) -> dict:
    """A JSON file of a dataset.

    Raises:
        ValueError: it is damaged, or not there.
    """
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read ({error}); restore it or record the dataset again"
        ) from error


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
    return info


def read_table(root: Path, info: dict, columns: list[str]) -> pa.Table:
    """These columns of all data files, and ``index`` and ``episode_index``, in order of time.

    Raises:
        ValueError: a file is damaged, or frames are missing.
    """
    files = sorted((root / "data").glob("*/*.parquet"))
    try:
        tables = [pq.ParquetFile(file).read(["index", "episode_index", *columns]) for file in files]
        table = pa.concat_tables(tables) if tables else []
    except (OSError, pa.ArrowException) as error:
        raise ValueError(
            f"{root} has a damaged or unfinished data file ({error}); restore it or record the dataset again"
        ) from error
    if not len(table) or len(table) != info["total_frames"]:
        raise ValueError(
            f"{root} is incomplete: {len(table)} of {info['total_frames']} frames; restore it or record it again"
        )
    return table.sort_by("index")


def read_column(root: Path, name: str, column: pa.ChunkedArray, dtype=np.float32) -> torch.Tensor:
    """The column's numbers, one after the other, as memory of their own.

    Raises:
        ValueError: some are missing or not finite.
    """
    flat = column.combine_chunks()
    while pa.types.is_list(flat.type) or pa.types.is_fixed_size_list(flat.type):
        flat = flat.flatten()
    values = flat.to_numpy(zero_copy_only=False)
    values = values.astype(bool if values.dtype == bool else dtype)
    if column.null_count or not np.isfinite(values).all():
        raise ValueError(f"{root} has numbers in {name} that are missing or not finite; record it again")
    return torch.from_numpy(values)


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
