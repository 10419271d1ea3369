"""Recording of a person's demonstrations: every episode is written at once, and all are merged into a dataset."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from tensordict import TensorDict

from dynmap_rl.envs.scene import SEEDS_PER_SPLIT, scene_seed
from dynmap_rl.utils.files import lock_folder, read_json, write_json

from ..demonstrations import META, load_meta
from .plans import Plan
from .shards import ROWS, Shard, merge_shards, parts_folder, write_shard

KIND = "human"


def keep_episode(root: str | Path, task: str, episode: TensorDict, scene_seed: int) -> int:
    """Write an episode beside a dataset, as one of its shards.

    Args:
        root: folder of the dataset.
        task: name of the task.
        episode: ``[1, T]`` (see :func:`dynmap_rl.data.recording.plans.run_plans`).
        scene_seed: seed of its scene.

    Returns:
        The number of episodes kept so far.

    Raises:
        ValueError: the folder is a dataset of another kind or task.
        OSError: the folder does not hold what was written.
    """
    open_folder(root, task)
    shards = list_shards(root, task)
    number = 1 + max((int(shard.folder.name) for shard in shards), default=-1)
    write_shard(parts_folder(root) / f"{number:04d}", task, [Plan(scene_seed, checkpoint=KIND)], episode)
    return len(shards) + 1


def publish_episodes(root: str | Path, task: str) -> Path:
    """Merge all kept episodes into a dataset; the last tenth, at least one episode, is the split ``eval``.

    The episodes stay in ``ROOT.parts``, to be merged again with later ones.

    Args:
        root: folder of the dataset.
        task: name of the task.

    Returns:
        The folder of the dataset.

    Raises:
        ValueError: there are fewer than two episodes.
    """
    root, shards = Path(root), list_shards(root, task)
    if len(shards) < 2:
        raise ValueError(
            f"{root} must have at least two episodes, one for each split, got {len(shards)}; keep more"
        )
    train = len(shards) - max(1, len(shards) // 10)
    shards = shards[:train] + [replace(shard, split="eval") for shard in shards[train:]]
    temporary = merged, old, _ = [parts_folder(root) / f"{name}.tmp" for name in ("merged", "old", "cache")]
    for leftover in temporary:
        shutil.rmtree(leftover, ignore_errors=True)
    settings = {"task": task, "expert": KIND, "kind": KIND, "episodes": train}
    merge_shards(shards, merged, settings)
    if root.exists():
        root.replace(old)
    merged.replace(root)
    for leftover in temporary:
        shutil.rmtree(leftover, ignore_errors=True)
    return root


def open_folder(root: str | Path, task: str) -> None:
    """Create and lock the folder of the episodes.

    Args:
        root: folder of the dataset.
        task: name of the task.

    Raises:
        ValueError: ``root`` is something else than a person's recording of this task, or another process records to it.
    """
    root, settings = Path(root), {"kind": KIND, "task": task}
    stored, path = settings, parts_folder(root) / "settings.json"
    if (root / META).exists():
        stored = load_meta(root)
    elif root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(
            f"{root} must be a recording or a new folder, got something else; choose another folder"
        )
    elif path.exists():
        stored = read_json(path)
    if any(stored.get(name) != value for name, value in settings.items()):
        raise ValueError(
            f"{root} must be a recording of kind {KIND} of {task}, got {stored.get('kind')} of {stored.get('task')}; "
            "choose another folder"
        )
    if (root / META).exists() and len(list_shards(root, task)) < (there := len(stored["episodes"])):
        raise ValueError(
            f"{parts_folder(root)} must hold the {there} episodes of {root}, to merge them with new ones, got fewer; choose "
            "another folder"
        )
    lock_folder(parts_folder(root))
    write_json(path, settings)


def list_shards(root: str | Path, task: str) -> list[Shard]:
    """Return the kept episodes, each a dataset of its own."""
    folders = sorted(path for path in parts_folder(root).glob("[0-9]*") if path.suffix != ".tmp")
    return [Shard(folder, task, KIND, KIND, "train", number, 1) for number, folder in enumerate(folders)]


def next_scene(root: str | Path, task: str) -> int:
    """Return the number of the first scene of the split ``train`` after all scenes of kept episodes."""
    rows = [row for shard in list_shards(root, task) for row in read_json(shard.folder / ROWS, list)]
    numbers = [row["scene_seed"] - scene_seed("train", 0) for row in rows]
    return 1 + max((n for n in numbers if 0 <= n < SEEDS_PER_SPLIT), default=-1)
