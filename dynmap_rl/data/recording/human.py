"""Demonstrations of a person: an episode at a time, each safe as soon as it is kept, merged into a LeRobot dataset."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from tensordict import TensorDict

from ..demonstrations import META, load_meta
from .plans import Plan
from .shards import FORMAT, ROWS, Shard, merge_shards, write_shard
from dynmap_rl.envs.scene import SEEDS_PER_SPLIT, scene_seed
from dynmap_rl.utils.files import lock_folder, read_json, write_json

KIND = "human"


def keep_episode(root: str | Path, task: str, episode: TensorDict, scene_seed: int) -> int:
    """Write an episode ``[1, 120]`` (see ``demonstrations.roll_out``) beside the dataset ``root``, as one of its shards.

    Returns:
        How many there are now.

    Raises:
        ValueError: the folder is a dataset of another kind or task.
        OSError: the disk does not hold the episode.
    """
    open_folder(root, task)
    shards = list_shards(root, task)
    number = 1 + max((int(shard.folder.name) for shard in shards), default=-1)
    write_shard(_parts(root) / f"{number:04d}", task, [Plan(scene_seed, checkpoint=KIND)], episode)
    return len(shards) + 1


def publish_episodes(root: str | Path, task: str) -> Path:
    """Merge all kept episodes into the dataset ``root``; the last tenth of them, at least one, are the split ``eval``.

    The episodes stay beside it, in ``ROOT.parts``, to be merged again with those that will be added.

    Raises:
        ValueError: there are fewer than two.
    """
    root, shards = Path(root), list_shards(root, task)
    if len(shards) < 2:
        raise ValueError(
            f"{root} needs two episodes at least, one to train and one to test; {len(shards)} kept so far"
        )
    train = len(shards) - max(1, len(shards) // 10)
    shards = shards[:train] + [replace(shard, split="eval") for shard in shards[train:]]
    temporary = merged, old, _ = [_parts(root) / f"{name}.tmp" for name in ("merged", "old", "cache")]
    for leftover in temporary:
        shutil.rmtree(leftover, ignore_errors=True)
    settings = {"format": FORMAT, "task": task, "expert": KIND, "kind": KIND, "episodes": train}
    merge_shards(shards, merged, settings)
    if root.exists():
        root.replace(old)
    merged.replace(root)
    for leftover in temporary:
        shutil.rmtree(leftover, ignore_errors=True)
    return root


def open_folder(root: str | Path, task: str) -> None:
    """Make the folder of the episodes.

    Raises:
        ValueError: ``root`` is a dataset of another kind or task, or something else, or another process records to it.
    """
    root, settings = Path(root), {"kind": KIND, "task": task}
    stored, path = settings, _parts(root) / "settings.json"
    if (root / META).exists():
        stored = load_meta(root)
    elif root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(f"{root} exists and is no dataset of ours; choose another folder")
    elif path.exists():
        stored = read_json(path)
    if (root / META).exists() and len(list_shards(root, task)) < (there := len(stored["episodes"])):
        raise ValueError(
            f"{root} has {there} episodes, but {_parts(root)} no longer holds them all, to be merged with new ones; "
            "choose another folder"
        )
    if any(stored.get(name) != value for name, value in settings.items()):
        raise ValueError(
            f"{root} is for {stored.get('kind')} of {stored.get('task')}, not for those of a person in {task}; "
            "choose another folder"
        )
    lock_folder(_parts(root))
    write_json(path, settings)


def list_shards(root: str | Path, task: str) -> list[Shard]:
    """The kept episodes, each a dataset of its own."""
    folders = sorted(path for path in _parts(root).glob("[0-9]*") if path.suffix != ".tmp")
    return [Shard(folder, task, KIND, KIND, "train", number, 1) for number, folder in enumerate(folders)]


def next_scene(root: str | Path, task: str) -> int:
    """The number of the first scene of the split ``train`` after all that episodes were kept of."""
    rows = [row for shard in list_shards(root, task) for row in read_json(shard.folder / ROWS, list)]
    numbers = [row["scene_seed"] - scene_seed("train", 0) for row in rows]
    return 1 + max((n for n in numbers if 0 <= n < SEEDS_PER_SPLIT), default=-1)


def _parts(root: str | Path) -> Path:
    root = Path(root)
    return root.with_name(f"{root.name}.parts")
