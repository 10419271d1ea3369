"""Expert rollouts written as a LeRobot v3.0 dataset with dynamics columns.

A recording is made of shards. Each is a small dataset of its own in ``<root>.parts``, written under a temporary
name, read back, and renamed; at the end they are merged into ``<root>``. A killed recording keeps its finished
shards, and the same call goes on: every shard has scenes of its own, so that the result depends neither on the
interruption nor on the number of workers.
"""

from __future__ import annotations

import multiprocessing
import shutil
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tqdm import tqdm

from ..demonstrations import META, load_meta
from ..format.writing import merge_datasets, write_episodes
from .plans import Plan, plan_demonstrations, plan_exploration, roll_out
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, ACTION_LIMIT, EPISODE_STEPS, VELOCITY_LIMIT
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import start_worker

FORMAT = 2  # of what is recorded, and how: a recording of another is another one
ROWS = "episodes.json"  # a shard's rows of the metadata
KINDS = ("demonstrations", "exploration")
SHARD_EPISODES = 25
CANDIDATES_PER_SHARD = 250  # scenes that belong to a shard, of which it takes the first that succeed
EXPLORATION_EVAL_START = 50_000_000


@dataclass(frozen=True)
class Shard:
    """``count`` episodes of a split, from candidate ``number * CANDIDATES_PER_SHARD`` on."""

    folder: Path
    task: str
    expert: str
    kind: str
    split: str
    number: int
    count: int


def record_dataset(
    root: str | Path,
    task: str = "balance_reaching",
    kind: str = "demonstrations",
    episodes: int = 300,
    eval_episodes: int = 50,
    workers: int = 2,
    expert: str | Path | None = None,
) -> Path:
    """Record training and evaluation episodes, or go on with a recording that was interrupted.

    Args:
        root: folder of the dataset; one that is complete already is left as it is.
        kind: ``demonstrations`` (successful episodes only) or ``exploration`` (noise and detours, all episodes).
        episodes, eval_episodes: the first are the split ``train``, the others ``eval``.
        workers: processes.
        expert: folder of the expert's checkpoints; by default the one that ships for the task.

    Raises:
        ValueError: the folder holds something else, is being recorded to, or not enough episodes succeed.
        OSError: the folder cannot be written, or a worker died. Finished shards are kept.
    """
    from filelock import FileLock, Timeout

    root = Path(root).expanduser()
    settings = {"task": task, "kind": kind, "episodes": episodes, "eval_episodes": eval_episodes}
    settings |= {"expert": str(expert or task), "format": FORMAT}
    _check_settings(root, settings)
    parts = root.with_name(f"{root.name}.parts")
    if (root / META).exists() and not parts.exists():
        return root
    try:
        parts.mkdir(parents=True, exist_ok=True)
        with FileLock(parts / ".lock", timeout=0):
            if not (root / META).exists():
                _record(root, parts, settings, workers)
            shutil.rmtree(parts)
    except Timeout as error:
        raise ValueError(f"{root} is being recorded by another process; wait for it or stop it") from error
    except BrokenProcessPool as error:
        raise OSError(
            f"a worker died while recording {root}; the same call goes on, try fewer workers"
        ) from error
    except OSError as error:
        raise OSError(
            f"cannot record {root} ({error}); is there space, and may the folder be written? The same call goes on"
        ) from error
    return root


def normalization_constants(episodes: TensorDict) -> dict[str, dict[str, list[float]]]:
    """``low`` and ``high`` ``[D]`` of action, goal, position, velocity and acceleration, in SI units.

    The natural range of each, so that a dimension that hardly varies is not blown up: the scene (0 to 1 m), half a
    radian, and the cart's limits of speed and acceleration, for the block too. Where more than one in a thousand
    of the values lie beyond, the range is widened about its middle to hold all but those.

    Args:
        episodes: ``[E, T]`` training episodes, as :func:`load_dataset` returns them.
    """
    natural = {  # middle and half width
        "action": (0.0, ACTION_LIMIT),
        "goal": (0.5, np.full(2, 0.5)),
        "position": (np.tile([0.5, 0.5, 0.0], 2), np.full(6, 0.5)),
        "velocity": (0.0, np.tile(VELOCITY_LIMIT, 2)),
        "acceleration": (0.0, np.tile(ACCELERATION_LIMIT, 2)),
    }
    constants = {}
    for name, (middle, half) in natural.items():
        values = episodes[name if name in ("action", "goal") else ("dynamics", name)]
        reach = np.abs(values.flatten(0, 1).double().numpy() - middle)  # [N, D]
        half = np.maximum(half, np.quantile(reach, 0.999, axis=0))
        constants[name] = {"low": (middle - half).tolist(), "high": (middle + half).tolist()}
    return constants


def _check_settings(root: Path, settings: dict) -> None:
    get_task(settings["task"])
    list_checkpoints(settings["expert"])
    if settings["kind"] not in KINDS:
        raise ValueError(f"unknown kind {settings['kind']!r}; choose from {KINDS}")
    if settings["episodes"] < 1 or settings["eval_episodes"] < 1:
        raise ValueError("a dataset needs at least one episode of each split, train and eval")
    stored = None
    if (root / META).exists():
        meta = load_meta(root)
        sizes = {name: end - first for name, (first, end) in meta["splits"].items()}
        stored = {name: meta.get(name) for name in ("task", "kind", "expert", "format")}
        stored |= {"episodes": sizes["train"], "eval_episodes": sizes["eval"]}
    elif root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(f"{root} exists and is no dataset of ours; choose another folder or delete it")
    elif (parts := root.with_name(f"{root.name}.parts") / "settings.json").exists():
        stored = read_json(parts)
    if stored not in (None, settings):
        changed = ", ".join(
            f"{k}: {stored.get(k)} there, {v} here" for k, v in settings.items() if stored.get(k) != v
        )
        raise ValueError(f"{root} holds another recording ({changed}); choose another folder or delete it")


def _record(root: Path, parts: Path, settings: dict, workers: int) -> None:
    write_json(parts / "settings.json", settings)
    for leftover in parts.glob("*.tmp"):
        shutil.rmtree(leftover)
    shards = _plan_shards(parts, settings)
    todo = [shard for shard in shards if not shard.folder.exists()]
    total, left = (sum(shard.count for shard in s) for s in (shards, todo))
    with tqdm(total=total, initial=total - left, unit="episode", desc=f"recording {root.name}") as progress:
        for shard in _run_shards(todo, workers):
            progress.update(shard.count)
    merged = parts / "merged.tmp"
    merge_shards(shards, merged, settings)
    merged.replace(root)


def _plan_shards(parts: Path, settings: dict) -> list[Shard]:
    return [
        Shard(
            folder=parts / f"{split}_{number:04d}",
            task=settings["task"],
            expert=settings["expert"],
            kind=settings["kind"],
            split=split,
            number=number,
            count=min(SHARD_EPISODES, total - number * SHARD_EPISODES),
        )
        for split, total in (("train", settings["episodes"]), ("eval", settings["eval_episodes"]))
        for number in range(-(-total // SHARD_EPISODES))
    ]


def _run_shards(shards: list[Shard], workers: int):
    """Yields each shard when it is on the disk."""
    workers = min(workers, len(shards))
    if workers <= 1:
        for shard in shards:
            _record_shard(shard)
            yield shard
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context, initializer=start_worker) as pool:
        futures = {pool.submit(_record_shard, shard): shard for shard in shards}
        try:
            for future in as_completed(futures):
                future.result()
                yield futures[future]
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _record_shard(shard: Shard) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # processes share the cores, and a sum's last bit may depend on the threads
    try:
        plans, episodes = _roll_out_shard(shard)
    finally:
        torch.set_num_threads(threads)
    write_shard(shard.folder, shard.task, plans, episodes)


def write_shard(folder: Path, task: str, plans: list[Plan], episodes: TensorDict) -> None:
    """A dataset of its own with what is known of its episodes ``[E, T]``; it appears when it is whole."""
    temporary = folder.with_name(f"{folder.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)  # of a killed process
        write_episodes(temporary, episodes, get_task(task).description)
        rows = [describe_episode(task, *e) for e in zip(plans, episodes, strict=True)]
        write_json(temporary / ROWS, rows)
        temporary.replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _roll_out_shard(shard: Shard) -> tuple[list[Plan], TensorDict]:
    """The first ``count`` candidates that succeed, or, of an exploration, simply the first."""
    plans, kept, missing, start = [], [], shard.count, 0
    while missing:
        size = missing if shard.kind == "exploration" else missing + missing // 8 + 2
        if start + size > CANDIDATES_PER_SHARD:
            raise ValueError(
                f"only {len(plans)} of {start} candidates of {shard.task} succeeded; train a better expert with "
                "recipes/expert.py"
            )
        candidates = _plan(shard, shard.number * CANDIDATES_PER_SHARD + start, size)
        episodes = roll_out(shard.task, candidates, shard.expert)
        good = episodes["next", "is_success"][:, -1, 0] | (shard.kind == "exploration")
        chosen = good.nonzero()[:missing, 0]
        plans += [candidates[i] for i in chosen.tolist()]
        kept.append(episodes[chosen])
        missing, start = missing - len(chosen), start + size
    return plans, torch.cat(kept)


def _plan(shard: Shard, start: int, count: int) -> list[Plan]:
    if shard.kind == "demonstrations":
        return plan_demonstrations(shard.task, shard.split, start, count, shard.expert)
    offset = EXPLORATION_EVAL_START if shard.split == "eval" else 0
    return plan_exploration(shard.task, "exploration", offset + start, count, shard.expert)


def describe_episode(task: str, plan: Plan, episode: TensorDict) -> dict:
    """An episode's row of the metadata."""
    scene = get_task(task).sample_scene(np.random.default_rng(plan.scene_seed))
    end = episode["next"][-1]
    return {
        **asdict(plan),
        "scene": scene.to_dict(),
        "success": bool(end["is_success"]),
        "dropped": bool(end["dropped"]),
        "position_error": end["position_error"].item(),
    }


def merge_shards(shards: list[Shard], folder: Path, settings: dict) -> None:
    """All episodes of shards as one dataset with its metadata; the first ``episodes`` of the settings are for training."""
    rows = [{"split": s.split, **row} for s in shards for row in read_json(s.folder / ROWS, list)]
    train = settings["episodes"]
    splits = {"train": [0, train], "eval": [train, len(rows)]}
    episodes = merge_datasets([s.folder for s in shards], folder, splits)
    if episodes.shape != (len(rows), EPISODE_STEPS):
        raise OSError(f"{folder} holds {tuple(episodes.shape)} episodes and steps after merging")
    meta = {name: settings[name] for name in ("format", "task", "expert", "kind")} | {"splits": splits}
    meta["normalization"] = normalization_constants(episodes[:train])
    meta["episodes"] = [{"episode_index": i, **row} for i, row in enumerate(rows)]
    write_json(folder / META, meta)
