"""Decoded episodes on disk, mapped into memory: for data larger than memory, and shared by processes.

A cache is a folder ``DATASET.cache`` beside the dataset's folder, or in a folder that the user names. It holds one entry,
named after the dataset's content and written by TensorDict, which appears when it is complete.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
import shutil
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from filelock import FileLock
from tensordict import TensorDict

from dynmap_rl.utils.files import check_space, read_json, write_json

from .decoding import Allocate

FORMAT = 1  # of the entries
SIZES = "sizes.json"  # of the files of an entry, written last
# Without this flag, which Python names from 3.13 on, Linux refuses to map files that are larger than its memory.
NORESERVE = getattr(mmap, "MAP_NORESERVE", 0x4000 if sys.platform == "linux" else 0)


def open_cached(
    root: Path, settings: object, build: Callable[[Allocate], None], cache: Path | None = None
) -> TensorDict:
    """Open the decoded episodes of a dataset, which are built where they are missing, stale or cut short.

    Other processes wait for the one that builds. Entries of other content or settings are deleted.

    Args:
        root: folder of the dataset.
        settings: JSON values on which the result depends beside the dataset's files.
        build: function that decodes the dataset into tensors. It gets a function of key, shape and dtype that returns a
            tensor on disk.
        cache: folder for the caches of several datasets; by default the cache lies beside the dataset.

    Returns:
        What was built. Changes of its tensors stay in this process.

    Raises:
        OSError: the cache cannot be written, or the disk is full.
    """
    place = _find_place(root.resolve(), cache)
    name = hash_content(root, settings)
    entry = place / name
    try:
        if not _is_whole(entry):
            place.mkdir(parents=True, exist_ok=True)
            with FileLock(place / ".lock"):
                if not _is_whole(entry):
                    _build(entry, build)
                    for other in place.iterdir():
                        if other.is_dir() and other != entry:
                            # A kill while it is deleted must not leave a part of it under its name.
                            shutil.rmtree(other.rename(other.with_suffix(".tmp")), ignore_errors=True)
        return _map(entry)
    except OSError as error:
        if error.errno is None:
            raise
        message = f"cannot cache {root} in {place} ({error.strerror}); choose another folder with --cache"
        raise OSError(message) from error


def _find_place(root: Path, cache: Path | None) -> Path:
    if cache is None and root.parent.name == "snapshots":  # of the hub's cache
        return root.parents[1] / "dynmap_rl.cache"  # one for all snapshots, so that old ones are deleted
    if cache is None:
        return root.with_name(f"{root.name}.cache")
    path = hashlib.sha256(str(root).encode()).hexdigest()[:8]  # datasets may have the same name
    return Path(cache).expanduser() / f"{root.name}_{path}"


def hash_content(root: Path, settings: object = None) -> str:
    """Return a name that depends on the settings and on every byte of ``meta/info.json``, of the data and of the videos."""
    files = [root / "meta/info.json", *sorted((root / "data").glob("*/*.parquet"))]
    files += sorted((root / "videos").rglob("*.mp4"))

    def digest(path: Path) -> bytes:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").digest()

    with ThreadPoolExecutor() as pool:  # hashing releases the interpreter's lock
        digests = list(pool.map(digest, files))
    names = [path.relative_to(root).as_posix() for path in files]
    head = json.dumps([FORMAT, settings, names]).encode()
    return hashlib.sha256(b"".join([head, *digests])).hexdigest()[:16]


def _build(entry: Path, build: Callable[[Allocate], None]) -> None:
    temporary = entry.with_name(f"{entry.name}.tmp")
    try:
        for leftover in entry.parent.glob("*.tmp"):  # of a killed process
            shutil.rmtree(leftover)
        episodes = TensorDict({}).memmap_(temporary)

        def allocate(key, shape, dtype) -> torch.Tensor:
            size = math.prod(shape) * dtype.itemsize
            check_space(temporary, size)
            values = episodes.make_memmap(key, shape, dtype=dtype)
            # A full disk would otherwise kill the process that writes.
            if size and hasattr(os, "posix_fallocate"):
                with open(values.filename, "r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, size)
            return values

        build(allocate)
        write_json(temporary / SIZES, _measure(temporary))
        if entry.exists():  # not whole
            shutil.rmtree(entry.rename(entry.with_suffix(".old.tmp")))
        temporary.replace(entry)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _is_whole(entry: Path) -> bool:
    """Return whether an entry exists and its files have their sizes: a copy that was cut short would be read as zeros."""
    try:
        sizes = read_json(entry / SIZES)
    except (FileNotFoundError, ValueError):
        return False
    return sizes == _measure(entry)


def _measure(entry: Path) -> dict[str, int]:
    """Return the size of every file of an entry (bytes)."""
    files = (path for path in entry.rglob("*") if path.is_file() and path != entry / SIZES)
    return {path.relative_to(entry).as_posix(): path.stat().st_size for path in files}


def _map(entry: Path) -> TensorDict:
    """Map an entry. Pages that are changed are copied, so that the files stay as they are."""
    flags = mmap.MAP_PRIVATE | NORESERVE

    def private(values: torch.Tensor) -> torch.Tensor:
        if not values.numel():
            return torch.empty(values.shape, dtype=values.dtype)
        with open(values.filename, "rb") as file:
            buffer = mmap.mmap(file.fileno(), values.numel() * values.element_size(), flags=flags)
        return torch.frombuffer(buffer, dtype=values.dtype).view(values.shape)

    episodes = TensorDict.load_memmap(entry)
    data = {key: private(episodes.get(key)) for key in episodes.keys(True, True)}
    return TensorDict(data, data["action"].shape[:2])
