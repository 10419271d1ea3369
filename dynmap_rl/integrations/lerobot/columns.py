"""The columns that LeRobot's preprocessors drop on the way to a policy, read from the dataset's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import META, NEEDED, load_meta
from dynmap_rl.data.recording.shards import normalization_constants
from dynmap_rl.envs.tasks import get_task


def read_columns(root: str | Path) -> TensorDict:
    """All numbers of a dataset but the frames, in memory.

    Args:
        root: its folder.

    Returns:
        ``[N]``, the frames that are on this machine: ``index`` ``[N]``, LeRobot's number of the frame, which increases;
        ``action`` ``[N, 3]``, ``goal`` ``[N, 2]``, ``("dynamics", "position" | "velocity" | "acceleration")``
        ``[N, 6]`` in SI units, and ``disturbed`` ``[N, 1]``: the steps in which a push acted, so far as the recording
        tells.

    Raises:
        ValueError: columns are missing, numbers are not finite, or the files are not on this machine.
    """
    files = sorted((Path(root) / "data").glob("*/*.parquet"))
    if not files:
        raise ValueError(f"{root} has no data files; the policy dynmap cannot train on a streamed dataset")
    if missing := set(NEEDED.values()) - set(pq.read_schema(files[0]).names):
        raise ValueError(f"{root} lacks the columns {', '.join(sorted(missing))}, which dynmap learns from")
    names = ["index", "episode_index", "frame_index", *NEEDED.values()]
    table = pa.concat_tables([pq.ParquetFile(file).read(names) for file in files]).sort_by("index")
    index = table["index"].to_numpy()
    if not (np.diff(index) > 0).all():
        raise ValueError(f"{root} has frames with the same index; repair the dataset or record it again")
    data = {key: torch.from_numpy(np.stack(table[name].to_numpy())).float() for key, name in NEEDED.items()}
    if broken := [NEEDED[key] for key, values in data.items() if not values.isfinite().all()]:
        raise ValueError(f"{root} has numbers in {', '.join(broken)} that are not finite; record it again")
    data["goal"] = data.pop("agent_pos")[:, -2:]
    data["index"], data["disturbed"] = torch.tensor(index), _mark_pushes(Path(root), table)
    return TensorDict(data, [len(table)])


def _mark_pushes(root: Path, table: pa.Table) -> torch.Tensor:
    episode, frame = table["episode_index"].to_numpy(), table["frame_index"].to_numpy()
    pushed = np.zeros((len(table), 1), bool)
    for row in load_meta(root)["episodes"] if (root / META).exists() else ():
        for start, end in row.get("pushes", ()):
            pushed[(episode == row["episode_index"]) & (frame >= start) & (frame < end)] = True
    return torch.from_numpy(pushed)


def find_constants(root: str | Path, columns: TensorDict) -> dict[str, dict[str, list[float]]]:
    """The constants of normalisation (see :func:`dynmap_rl.data.normalization_constants`): those of the recording, or,
    of a dataset that has been edited since, of all its frames."""
    if (Path(root) / META).exists():
        return load_meta(root)["normalization"]
    return normalization_constants(columns[None])


def find_task(root: str | Path) -> str | None:
    """The dataset's task; None where it does not tell, such as one that has been edited."""
    return load_meta(root)["task"] if (Path(root) / META).exists() else None


def is_symmetric(task: str | None) -> bool:
    """Whether mirrored and shifted demonstrations of a task are demonstrations; not where there is no task."""
    return task is not None and get_task(task, from_file=True).symmetric
