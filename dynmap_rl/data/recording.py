# NOTE TO THE HELPER WHO OWNS THIS FILE: the lead wrote this version because nothing was here yet (it works).
# It is yours again: keep or replace it, keep the public signatures, delete this note.
"""Expert rollouts written as a LeRobot v3 dataset with dynamics columns.

A recording is made of shards. Each is a small dataset of its own in ``<root>.parts``, written under a temporary name,
finalised and renamed; at the end they are merged into ``<root>``. A killed recording keeps its finished shards, and
the same call goes on: each shard has its own fixed scenes, so that the result does not depend on the interruption
or on the number of workers.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import logging
import multiprocessing
import os
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from tqdm import tqdm

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, CONTROL_DT, VELOCITY_LIMIT
from dynmap_rl.runs import read_json, write_json

from .demonstrations import Plan, plan_demonstrations, plan_exploration, roll_out

CAMERA = "observation.images.front"
META = "meta/dynmap.json"
FPS = round(1 / CONTROL_DT)
SHARD_EPISODES = 25
CANDIDATES_PER_SHARD = 1000
EXPLORATION_EVAL_START = 50_000_000

POSE = ["cart_x", "cart_y", "cart_theta"]
BODIES = [*POSE, "block_x", "block_y", "block_theta"]
FEATURES = {
    CAMERA: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
    "observation.state": {"dtype": "float32", "shape": (5,), "names": [*POSE, "goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (3,), "names": ["delta_x", "delta_y", "delta_theta"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "dynamics.position": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.velocity": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.acceleration": {"dtype": "float32", "shape": (6,), "names": BODIES},
}


def record_dataset(
    root: str | Path,
    task: str = "balance_reaching",
    kind: str = "demonstrations",
    episodes: int = 300,
    eval_episodes: int = 50,
    workers: int = 2,
) -> Path:
    """Record training and evaluation episodes, or go on with a recording that was interrupted.

    Args:
        root: folder of the dataset.
        kind: ``demonstrations`` (successful episodes only) or ``exploration`` (noise and detours, all episodes).
        episodes, eval_episodes: the first are the split ``train``, the others ``eval``.
        workers: processes.

    Raises:
        ValueError: the folder holds another recording, or not enough episodes succeed.
        OSError: the folder cannot be written.
    """
    root = Path(root)
    settings = {"task": task, "kind": kind, "episodes": episodes, "eval_episodes": eval_episodes}
    _check_settings(root, settings)
    if root.exists():
        return root
    parts = root.with_name(root.name + ".parts")
    write_json(parts / "settings.json", settings)
    for leftover in parts.glob("*.tmp*"):
        shutil.rmtree(leftover)
    shards = _plan_shards(parts, settings)
    todo = [shard for shard in shards if not shard["folder"].exists()]
    with tqdm(total=episodes + eval_episodes, unit="episode", desc=f"recording {root.name}") as progress:
        progress.update(sum(s["count"] for s in shards) - sum(s["count"] for s in todo))
        for shard in _run_shards(todo, workers):
            progress.update(shard["count"])
    merged = parts / f"merged.tmp{os.getpid()}"
    _merge(shards, merged, settings)
    merged.replace(root)
    shutil.rmtree(parts)
    return root


def normalization_constants(episodes: TensorDict) -> dict[str, dict[str, list[float]]]:
    """``{"low": [D], "high": [D]}`` of every normalised quantity, in SI units.

    The natural range of each (the scene, half a radian, the cart's limits), so that a dimension that hardly varies
    is not blown up, and wider where more than one in a thousand of the training values lie beyond.

    Args:
        episodes: ``[E, T]`` training episodes.
    """
    natural = {
        "action": (-VELOCITY_LIMIT * CONTROL_DT, VELOCITY_LIMIT * CONTROL_DT),
        "goal": (np.zeros(2), np.ones(2)),
        "position": (np.tile([0.0, 0.0, -0.5], 2), np.tile([1.0, 1.0, 0.5], 2)),
        "velocity": (np.tile(-VELOCITY_LIMIT, 2), np.tile(VELOCITY_LIMIT, 2)),
        "acceleration": (np.tile(-ACCELERATION_LIMIT, 2), np.tile(ACCELERATION_LIMIT, 2)),
    }
    constants = {}
    for name, (low, high) in natural.items():
        key = name if name in ("action", "goal") else ("dynamics", name)
        values = episodes[key].flatten(0, 1).numpy().astype(np.float64)
        beyond = np.quantile(values, [0.0005, 0.9995], axis=0)
        constants[name] = {
            "low": np.minimum(low, beyond[0]).tolist(),
            "high": np.maximum(high, beyond[1]).tolist(),
        }
    return constants


def push_dataset(root: str | Path, repo_id: str) -> None:
    """Upload a recorded dataset to the Hugging Face hub, with a card and the tag that LeRobot resolves."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    meta = read_json(Path(root) / META)
    description = (
        f"{meta['settings']['kind'].capitalize()} of the task {meta['settings']['task']} of dynmap_rl: "
        f"{get_task(meta['settings']['task']).description} Made by state-based PPO experts in PyMunk at 20 Hz. "
        "Beside frames and actions every frame has the dynamics of cart and block: `dynamics.position` (m, m, rad), "
        "`dynamics.velocity` (m/s, rad/s) and `dynamics.acceleration` (m/s^2, rad/s^2), each cart x, y, theta, "
        "block x, y, theta. Scene, seed and expert of every episode and the normalisation constants are in "
        f"`{META}`."
    )
    dataset = LeRobotDataset(repo_id, root=root)
    dataset.push_to_hub(tags=["dynamics", "world-model"], license="mit", dataset_description=description)


def _check_settings(root: Path, settings: dict) -> None:
    parts = root.with_name(root.name + ".parts")
    for path in (root / META, parts / "settings.json"):
        if path.exists():
            stored = read_json(path)
            stored = stored.get("settings", stored)
            if stored != settings:
                raise ValueError(
                    f"{path.parent} holds another recording ({stored}); choose another folder or delete it"
                )
    if root.exists() and not (root / META).exists():
        raise ValueError(f"{root} exists and was not made by this recording; choose another folder")


def _plan_shards(parts: Path, settings: dict) -> list[dict]:
    shards = []
    for split, total in (("train", settings["episodes"]), ("eval", settings["eval_episodes"])):
        for number, start in enumerate(range(0, total, SHARD_EPISODES)):
            shards.append(
                {
                    "folder": parts / f"{split}_{number:04d}",
                    "split": split,
                    "number": number,
                    "count": min(SHARD_EPISODES, total - start),
                    "task": settings["task"],
                    "kind": settings["kind"],
                }
            )
    return shards


def _run_shards(shards: list[dict], workers: int):
    if workers <= 1 or len(shards) <= 1:
        for shard in shards:
            _record_shard(shard)
            yield shard
        return
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(min(workers, len(shards)), mp_context=context) as pool:
        futures = {pool.submit(_record_shard, shard): shard for shard in shards}
        try:
            for future in concurrent.futures.as_completed(futures):
                future.result()
                yield futures[future]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _record_shard(shard: dict) -> None:
    """Roll out one shard's episodes and write them, under a temporary name until they are complete."""
    torch.set_num_threads(1)
    plans, episodes = _roll_out_shard(shard)
    temporary = shard["folder"].with_name(f"{shard['folder'].name}.tmp{os.getpid()}")
    _write_episodes(temporary, episodes, get_task(shard["task"]).description)
    rows = [_episode_row(shard, plan, episode) for plan, episode in zip(plans, episodes, strict=True)]
    write_json(temporary / META, rows)
    temporary.replace(shard["folder"])


def _roll_out_shard(shard: dict) -> tuple[list[Plan], TensorDict]:
    plans, kept = [], []
    need, start = shard["count"], 0
    first = shard["number"] * CANDIDATES_PER_SHARD
    while need > 0:
        size = need if shard["kind"] == "exploration" else need + need // 8 + 2
        if start + size > CANDIDATES_PER_SHARD:
            raise ValueError(f"too few expert episodes of {shard['task']} succeed; train a better expert")
        candidates = _plan(shard, first + start, size)
        episodes = roll_out(shard["task"], candidates)
        good = torch.ones(size, dtype=torch.bool)
        if shard["kind"] == "demonstrations":
            good = episodes["next", "is_success"][:, -1, 0]
        index = good.nonzero()[:need, 0]
        plans += [candidates[i] for i in index.tolist()]
        kept.append(episodes[index])
        need, start = need - len(index), start + size
    return plans, torch.cat(kept)


def _plan(shard: dict, start: int, count: int) -> list[Plan]:
    if shard["kind"] == "demonstrations":
        return plan_demonstrations(shard["task"], shard["split"], start, count)
    if shard["kind"] == "exploration":
        offset = EXPLORATION_EVAL_START if shard["split"] == "eval" else 0
        return plan_exploration(shard["task"], "exploration", offset + start, count)
    raise ValueError(f"unknown kind {shard['kind']!r}; choose demonstrations or exploration")


def _write_episodes(folder: Path, episodes: TensorDict, task: str) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    with quiet():
        dataset = LeRobotDataset.create(
            "dynmap_rl/recording", FPS, FEATURES, root=folder, robot_type="dynmap_cart", use_videos=False
        )
        for episode in episodes:
            columns = {
                CAMERA: episode["pixels"].permute(0, 2, 3, 1).numpy(),
                "observation.state": episode["agent_pos"].numpy(),
                "action": episode["action"].numpy(),
                "next.reward": episode["next", "reward"].numpy(),
                "next.done": episode["next", "done"].numpy(),
                "next.success": episode["next", "is_success"].numpy(),
                **{f"dynamics.{k}": v.numpy() for k, v in episode["dynamics"].items()},
            }
            for t in range(len(episode)):
                dataset.add_frame({**{key: column[t] for key, column in columns.items()}, "task": task})
            # LeRobot computes the statistics in the buffer's precision, and float32 is not enough for variances.
            buffer = dataset.writer.episode_buffer
            for key, feature in FEATURES.items():
                if feature["dtype"] == "float32":
                    buffer[key] = [value.astype(np.float64) for value in buffer[key]]
            dataset.save_episode()
        dataset.finalize()


def _episode_row(shard: dict, plan: Plan, episode: TensorDict) -> dict:
    task = get_task(shard["task"])
    scene = task.sample_scene(np.random.default_rng(plan.scene_seed), None)
    last = episode["next"][-1]
    return {
        "split": shard["split"],
        **asdict(plan),
        "scene": scene.to_dict(),
        "success": bool(last["is_success"]),
        "dropped": bool(last["dropped"]),
        "position_error": round(last["position_error"].item(), 6),
    }


def _merge(shards: list[dict], folder: Path, settings: dict) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets
    from lerobot.datasets.io_utils import load_info, write_info

    from .loading import load_episodes

    folders = [shard["folder"] for shard in shards]
    with quiet():
        names = [f"dynmap_rl/{f.name}" for f in folders]
        aggregate_datasets(names, "dynmap_rl/recording", roots=folders, aggr_root=folder)
    rows = [row for f in folders for row in read_json(f / META)]
    train = settings["episodes"]
    info = load_info(folder)
    info.splits = {"train": f"0:{train}", "eval": f"{train}:{len(rows)}"}
    write_info(info, folder)
    episodes = load_episodes(folder)
    if episodes.shape != (len(rows), 120):
        raise ValueError(f"{folder} does not hold {len(rows)} episodes after merging; record again")
    write_json(
        folder / META,
        {
            "settings": settings,
            "splits": {"train": [0, train], "eval": [train, len(rows)]},
            "normalization": normalization_constants(episodes[:train]),
            "episodes": [{"episode_index": i, **row} for i, row in enumerate(rows)],
        },
    )


@contextlib.contextmanager
def quiet():
    """Hold back LeRobot's and datasets' progress bars and notes on missing video decoders."""
    import datasets
    import lerobot.datasets.aggregate as aggregate

    level = logging.root.manager.disable
    logging.disable(logging.WARNING)
    datasets.disable_progress_bars()
    bar, aggregate.tqdm.tqdm = aggregate.tqdm.tqdm, lambda rows, **_: rows
    try:
        yield
    finally:
        aggregate.tqdm.tqdm = bar
        logging.disable(level)
