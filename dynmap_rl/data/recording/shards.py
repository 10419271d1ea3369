"""Shards of a recording: small datasets that are written, checked and merged.

A shard is written under a temporary name, read back, and renamed, so that it is complete or missing at any moment. Every
shard has scenes of its own: its content depends neither on other shards nor on the process that records it.
"""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDict

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.utils.files import read_json, write_json

from ..demonstrations import FORMAT, META
from ..format.writing import merge_datasets, write_episodes
from ..normalization import layout_constants, normalization_constants
from .plans import Plan, mark_pushes, plan_demonstrations, plan_exploration, run_plans

ROWS = "episodes.json"  # metadata of a shard's episodes
CANDIDATES_PER_SHARD = 250  # scenes of a shard, which keeps the first that succeed
EXPLORATION_EVAL_START = 50_000_000


@dataclass(frozen=True)
class Shard:
    """Place and content of a shard.

    Attributes:
        folder: folder of the shard.
        task: name of the task.
        expert: folder or task of the expert's checkpoints.
        kind: kind of the recording.
        split: split of the episodes.
        number: number of the shard in its split. Candidates begin at ``number * CANDIDATES_PER_SHARD``.
        count: number of episodes.
    """

    folder: Path
    task: str
    expert: str
    kind: str
    split: str
    number: int
    count: int


def parts_folder(root: str | Path) -> Path:
    """Return the folder of the shards that become the dataset ``root``."""
    root = Path(root).absolute()
    return root.with_name(f"{root.name}.parts")


def record_shard(shard: Shard) -> None:
    """Roll the experts out and write the shard.

    Raises:
        ValueError: too few candidates succeed.
        OSError: the folder cannot be written.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # processes share the cores, and a sum's last bit may depend on the threads
    try:
        plans, episodes = _run_shard(shard)
    finally:
        torch.set_num_threads(threads)
    write_shard(shard.folder, shard.task, plans, episodes)


def write_shard(folder: Path, task: str, plans: list[Plan], episodes: TensorDict) -> None:
    """Write episodes and their metadata as a dataset of its own, which appears when it is complete.

    Args:
        folder: folder of the shard.
        task: name of the task.
        plans: one plan for each episode.
        episodes: ``[E, T]`` (see :func:`dynmap_rl.data.recording.plans.run_plans`).

    Raises:
        OSError: the folder does not hold what was written.
    """
    temporary = folder.with_name(f"{folder.name}.tmp")
    columns = episodes.copy().set("disturbed", mark_pushes(plans, episodes.shape[1]))
    try:
        shutil.rmtree(temporary, ignore_errors=True)  # of a killed process
        write_episodes(temporary, columns, get_task(task).description, get_task(task).layout)
        rows = [describe_episode(task, *e) for e in zip(plans, episodes, strict=True)]
        write_json(temporary / ROWS, rows)
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def describe_episode(task: str, plan: Plan, episode: TensorDict) -> dict:
    """Return the metadata of an episode ``[T]``."""
    end = episode["next"][-1]
    return {
        **asdict(plan),
        "scene": get_task(task).describe(plan.scene_seed),
        "success": bool(end["is_success"]),
        "dropped": bool(end["dropped"]),
        "position_error": end["position_error"].item(),
    }


def merge_shards(shards: list[Shard], folder: Path, settings: dict) -> None:
    """Merge shards into one dataset with metadata.

    Args:
        shards: the shards of the split ``train``, then the shards of ``eval``.
        folder: folder of the dataset, which must not exist.
        settings: ``task``, ``expert``, ``kind``, and ``episodes``, the number of training episodes.

    Raises:
        OSError: episodes are missing after merging.
    """
    rows = [{"split": s.split, **row} for s in shards for row in read_json(s.folder / ROWS, list)]
    train = settings["episodes"]
    splits = {"train": [0, train], "eval": [train, len(rows)]}
    task = get_task(settings["task"])
    layout = task.layout
    episodes = merge_datasets([s.folder for s in shards], folder, splits, layout)
    if episodes.shape != (len(rows), layout.steps):
        raise OSError(
            f"{folder} must have {len(rows)} episodes of {layout.steps} steps after merging, got "
            f"{tuple(episodes.shape)}; check the disk"
        )
    meta = {"format": FORMAT} | {name: settings[name] for name in ("task", "expert", "kind")}
    if task.planar:
        meta |= {"splits": splits, "normalization": normalization_constants(episodes[:train])}
    else:
        constants = layout_constants(episodes[:train], layout)
        meta |= {"layout": layout.to_dict(), "splits": splits, "normalization": constants}
    meta["rejected"] = sum(_count_rejected(shard) for shard in shards)
    meta["episodes"] = [{"episode_index": i, **row} for i, row in enumerate(rows)]
    write_json(folder / META, meta)


def _run_shard(shard: Shard) -> tuple[list[Plan], TensorDict]:
    """Return the first ``count`` candidates that succeed, or simply the first of an exploration."""
    plans, kept, missing, start = [], [], shard.count, 0
    one_by_one = get_task(shard.task).has_demonstrator  # no batch, in which some more take hardly longer
    while missing:
        size = missing if shard.kind == "exploration" or one_by_one else missing + missing // 8 + 2
        if start + size > CANDIDATES_PER_SHARD:
            better = (
                "improve its demonstrator, or its success condition"
                if one_by_one
                else "train a better expert with recipes/expert.py"
            )
            raise ValueError(
                f"{shard.count} of {start} candidates of {shard.task} must succeed, got {len(plans)}; {better}, and "
                f"delete {shard.folder.parent}"
            )
        candidates = _plan(shard, shard.number * CANDIDATES_PER_SHARD + start, size)
        episodes = run_plans(shard.task, candidates, shard.expert)
        good = episodes["next", "is_success"][:, -1, 0] | (shard.kind == "exploration")
        chosen = good.nonzero()[:missing, 0]
        plans += [candidates[i] for i in chosen.tolist()]
        kept.append(episodes[chosen])
        missing, start = missing - len(chosen), start + size
    return plans, torch.cat(kept)


def _count_rejected(shard: Shard) -> int:
    """Return how many candidates failed before the shard had its episodes; scenes are taken in order."""
    if shard.kind not in ("demonstrations", "undisturbed"):
        return 0
    first = _plan(shard, shard.number * CANDIDATES_PER_SHARD, 1)[0].scene_seed
    return read_json(shard.folder / ROWS, list)[-1]["scene_seed"] + 1 - first - shard.count


def _plan(shard: Shard, start: int, count: int) -> list[Plan]:
    if shard.kind != "exploration":
        disturbed = shard.kind != "undisturbed"
        return plan_demonstrations(shard.task, shard.split, start, count, shard.expert, disturbed)
    offset = EXPLORATION_EVAL_START if shard.split == "eval" else 0
    return plan_exploration(shard.task, "exploration", offset + start, count, shard.expert)
