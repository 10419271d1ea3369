"""Columns that LeRobot's preprocessors drop on the way to a policy, read from the dataset's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import find_meta
from dynmap_rl.data.format.reading import read_column, read_file, read_info
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.keys import FOUND, NEEDED

from .configuration_dynmap import GOAL

DISTURBED, EXPERT_ACTION = "disturbed", "expert_action"


def read_columns(root: str | Path) -> TensorDict:
    """Read the numbers of a dataset, without its frames, into memory.

    Args:
        root: folder of the dataset, which may hold only some of its episodes.

    Returns:
        ``[N]``, the frames on this machine: ``index`` ``[N]``, LeRobot's number of the frame, which increases;
        ``action`` ``[N, 3]``, ``goal`` ``[N, 2]``, ``("dynamics", "position" | "velocity" | "acceleration")``
        ``[N, 6]`` in SI units, ``step_count`` ``[N, 1]``, the number of the step in its episode, ``disturbed`` bool
        ``[N, 1]``, the steps in which a push acted; false without such a column, and, where the dataset has them,
        ``expert_action`` ``[N, 3]`` and ``labelled`` bool ``[N, 6]``, what was found in the frames.

    Raises:
        ValueError: columns are missing, numbers are not finite, or the files are not on this machine.
    """
    root = Path(root)
    info, columns = read_info(root), dict(NEEDED)
    find_meta(root)  # refuses recordings of an earlier release
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(
            f"{root} must have data files, got none; the policy dynmap cannot train on a streamed dataset"
        )
    if missing := set(NEEDED.values()) - set(pq.read_schema(files[0]).names):
        raise ValueError(
            f"{root} must have the columns {', '.join(sorted(missing))}; record a dataset with recipes/collect.py"
        )
    columns |= {name: name for name in (DISTURBED, EXPERT_ACTION) if name in info["features"]}
    columns |= {"labelled": FOUND} if FOUND in info["features"] else {}
    names = ["index", "frame_index", *columns.values()]
    table = pa.concat_tables([read_file(file, names) for file in files]).sort_by("index")
    index = table["index"].to_numpy()
    if not (np.diff(index) > 0).all():
        raise ValueError(
            f"{root} must have frames of different index, got repeated ones; repair the dataset or record it again"
        )
    data = {key: read_column(root, info, table, name) for key, name in columns.items()}
    data["goal"] = data.pop("agent_pos")[:, -GOAL:]
    data["index"] = torch.tensor(index)
    data["step_count"] = torch.tensor(table["frame_index"].to_numpy())[:, None]
    data[DISTURBED] = data.get(DISTURBED, torch.zeros(len(table), 1)).bool()
    return TensorDict(data, [len(table)])


def is_symmetric(task: str | None) -> bool:
    """Return whether mirrored and shifted demonstrations of a task are demonstrations; false for no task.

    Raises:
        ValueError: the task is not known, as a dataset must not run code.
    """
    try:
        return task is not None and get_task(task, from_file=True).symmetric
    except ValueError as error:
        raise ValueError(
            f"whether mirrored demonstrations of the dataset's task {task!r} are demonstrations is not known; give "
            "--policy.symmetric true or false"
        ) from error
