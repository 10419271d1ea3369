"""Copying of a LeRobot v3.0 dataset with further columns and their statistics.

``lerobot.datasets.dataset_tools.add_features`` writes no statistics of the new columns, is slow with image columns, and
leaves an incomplete folder behind when it is stopped.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from dynmap_rl.utils.files import read_json, write_bytes, write_json

from .quiet import quiet
from .reading import spans


@contextmanager
def new_folder(output: Path) -> Iterator[Path]:
    """Give a folder beside ``output`` that becomes it at the end of the block; after an error or Ctrl-C nothing is left.

    Args:
        output: the new folder.

    Raises:
        ValueError: another process is writing it.
        OSError: it cannot be written.
    """
    from filelock import FileLock, Timeout

    # One name, so that the next command deletes what a killed one has left.
    temporary = output.with_name(f".{output.name}.add_dynamics")
    try:
        temporary.mkdir(parents=True, exist_ok=True)
        with FileLock(temporary / ".lock", timeout=0):
            try:
                for old in temporary.iterdir():
                    shutil.rmtree(old) if old.is_dir() else old.name == ".lock" or old.unlink()
                yield temporary
                temporary.replace(output)
                (output / ".lock").unlink()
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
    except Timeout as error:
        raise ValueError(f"{output} is being written by another process; wait for it or stop it") from error
    except OSError as error:
        raise OSError(
            f"cannot write {output} ({error}); is there space, and may the folder be written?"
        ) from error


def write_columns(
    root: Path,
    output: Path,
    info: dict,
    table: pa.Table,
    values: dict[str, np.ndarray],
    names: list[str],
    replaced: dict[str, dict | None] | None = None,
) -> None:
    """Copy a dataset with new or replaced columns.

    Args:
        root: folder of the dataset.
        output: folder that is written to, such as that of :func:`new_folder`.
        info: content of the dataset's ``meta/info.json``.
        table: ``index`` and ``episode_index`` of all frames, in order.
        values: new columns, float32 or bool ``[N, D]``, by name.
        names: names of the D entries.
        replaced: content of JSON files by their paths relative to ``root``, in the place of the dataset's own; None
            leaves a file out.

    Raises:
        ValueError: a file of the dataset is damaged.
        OSError: the folder cannot be written.
    """
    replaced = replaced or {}
    stats = read_json(path) if (path := root / "meta" / "stats.json").exists() else {}
    for file in sorted(
        folder / name for folder, _, files in root.walk(follow_symlinks=True) for name in files
    ):
        relative = file.relative_to(root)
        if any(part.startswith(".") for part in relative.parts) or str(relative) in replaced:
            continue  # names with a dot are notes of the hub and of file managers
        target = output / relative
        target.parent.mkdir(parents=True, exist_ok=True)
        if relative.parts[0] == "data" and file.suffix == ".parquet":
            _write_rows(file, target, table["index"].to_numpy(), values)
        elif relative.parts[:2] == ("meta", "episodes") and file.suffix == ".parquet":
            _write_episodes(file, target, dict(spans(table["episode_index"].to_numpy())), values)
        else:
            shutil.copy2(file, target)
    shape = [len(names)]
    features = {n: {"dtype": str(v.dtype), "shape": shape, "names": names} for n, v in values.items()}
    write_json(output / "meta" / "info.json", info | {"features": info["features"] | features})
    for name, numbers in values.items():
        stats[name] = {key: value.tolist() for key, value in compute_stats(numbers).items()}
    # As LeRobot writes it: a column that is not used here may have NaN, which write_json would turn into null.
    write_bytes(output / "meta" / "stats.json", json.dumps(stats, indent=4).encode())
    for name, content in replaced.items():
        if content is not None:
            write_json(output / name, content)


def _write_rows(file: Path, target: Path, index: np.ndarray, values: dict[str, np.ndarray]) -> None:
    """Write a data file with the new columns, with one row group for each episode as LeRobot does."""
    with quiet():
        from lerobot.datasets.io_utils import write_table_one_row_group_per_episode

    rows = _read(file)
    place = np.searchsorted(index, rows["index"].to_numpy())
    rows = rows.drop_columns([name for name in values if name in rows.column_names])
    for name, numbers in values.items():
        size = numbers.shape[1]
        flat = pa.array(numbers[place].ravel())
        rows = rows.append_column(name, pa.FixedSizeListArray.from_arrays(flat, size) if size > 1 else flat)
    write_table_one_row_group_per_episode(_name_columns(rows), target)


def _read(file: Path) -> pa.Table:
    try:
        return pq.ParquetFile(file).read()
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{file} is damaged ({error}); restore it or download the dataset again") from error


def _name_columns(rows: pa.Table) -> pa.Table:
    """Update the description of the columns for the hub, whose viewer refuses files with an old one."""
    from datasets import Features

    if b"huggingface" not in (rows.schema.metadata or {}):
        return rows
    return rows.replace_schema_metadata(Features.from_arrow_schema(rows.schema).arrow_schema.metadata)


def _write_episodes(
    file: Path, target: Path, rows_of: dict[int, slice], values: dict[str, np.ndarray]
) -> None:
    """Write the episodes' metadata with statistics of the new columns."""
    rows = _read(file)
    old = tuple(f"stats/{name}/" for name in values)
    rows = rows.drop_columns([name for name in rows.column_names if name.startswith(old)])
    for name, numbers in values.items():
        stats = [compute_stats(numbers[rows_of[e]]) for e in rows["episode_index"].to_pylist()]
        for key in stats[0]:
            rows = rows.append_column(f"stats/{name}/{key}", pa.array([s[key].tolist() for s in stats]))
    pq.write_table(rows, target)


def compute_stats(numbers: np.ndarray) -> dict[str, np.ndarray]:
    """Return LeRobot's statistics of numbers ``[N, D]``."""
    from lerobot.datasets.compute_stats import get_feature_stats

    # float32 is not enough for variances.
    return get_feature_stats(numbers.astype(np.float64), axis=0, keepdims=False)
