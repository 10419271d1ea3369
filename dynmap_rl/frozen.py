"""Policies on a frozen world model, what decoupled training and generalisation share (paper, Sec. III-B and V-D).

The world model's states are computed once; every policy seed is then trained and judged in a process of its own,
and the weights of the world model are shown to be the same before and after.
"""

from __future__ import annotations

import multiprocessing
import shutil
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from dynmap_rl import data, modules, runs
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.evaluation import SHARED_STARTS, evaluate
from dynmap_rl.modules import WorldModel
from dynmap_rl.training import fingerprint, train_policy


def check_settings(settings) -> list[int]:
    """Refuse what cannot run, before anything is written.

    Args:
        settings: with ``task``, ``policy``, ``seeds``, ``dataset``, ``split``, ``policy_updates``,
            ``test_episodes`` and ``paper_episodes``.

    Returns:
        The seeds of the policies.

    Raises:
        ValueError: a setting is wrong; the message says which.
    """
    get_task(settings.task)
    modules.check_policy(settings.policy)
    try:
        seeds = [int(seed) for seed in settings.seeds.split(",")]
    except ValueError as error:
        raise ValueError(f"--seeds are whole numbers such as 0,1,2, not {settings.seeds!r}") from error
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"--seeds {settings.seeds} has one twice")
    if settings.split not in ("test", "validation"):
        raise ValueError(f"--split is test or validation, not {settings.split!r}")
    if settings.test_episodes > SHARED_STARTS:
        raise ValueError(f"there are {SHARED_STARTS} shared start states, not {settings.test_episodes}")
    if min(settings.policy_updates, settings.test_episodes, settings.paper_episodes) < 1:
        raise ValueError("updates and episodes must be at least 1")
    if settings.dataset and (task := data.load_meta(settings.dataset)["task"]) != settings.task:
        raise ValueError(f"{settings.dataset} holds the task {task}, not {settings.task}")
    return seeds


def find_or_record(settings) -> str | Path:
    """The dataset of the settings, or ``datasets/TASK``, recorded if it is not there (six episodes for a smoke run)."""
    if settings.dataset:
        return settings.dataset
    folder = Path("datasets") / get_task(settings.task).name
    if settings.smoke:
        folder = folder.with_name(f"{folder.name}_smoke")
        return data.record_dataset(folder, settings.task, episodes=4, eval_episodes=2, workers=1)
    return data.record_dataset(folder, settings.task)


def read_source(run: Path) -> dict[str, str]:
    """Where a run folder's world model is from: ``task`` and ``training`` (decoupled or joint).

    Raises:
        ValueError: the folder is no such run, or it is not done.
    """
    if not (run / "eval.json").exists():
        raise ValueError(f"{run} holds no finished run; train a world model with recipes/decoupled.py first")
    result = runs.read_json(run / "eval.json")
    return result.get("world_model", {"task": result["task"], "training": "decoupled"})


def train_policies(
    world_model: WorldModel,
    episodes: dict[str, TensorDictBase],
    constants: dict,
    folder: Path,
    settings,
    seeds: list[int],
) -> str:
    """Freeze the world model, train and judge a policy for every seed that ``folder`` does not hold yet.

    Args:
        world_model: stays as it is.
        episodes: ``train`` and ``eval``, ``[E, T]``.
        constants: of the dataset's normalisation.
        folder: run folder; gets ``world_model`` and ``seed_N`` with ``policy``, ``metrics.jsonl``, ``eval.json``.
        settings: of the policy's training (see :func:`dynmap_rl.training.train_policy`) and evaluation, with
            ``copies``.
        seeds: of the policies.

    Returns:
        The fingerprint of the frozen world model.

    Raises:
        ValueError: the frozen weights have changed.
        OSError: a process died.
    """
    world_model.eval().requires_grad_(False)
    frozen = fingerprint(world_model)
    modules.save_world_model(folder / "world_model", world_model)
    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    if todo:
        generator = torch.Generator().manual_seed(0)
        features = data.compute_features(world_model, episodes["train"], settings.copies, generator)
        features.memmap(folder / "features" / "train")
        data.compute_features(world_model, episodes["eval"]).memmap(folder / "features" / "eval")
        _run_seeds([(settings, folder, constants, seed, frozen) for seed in todo])
        shutil.rmtree(folder / "features")
    if fingerprint(modules.load_world_model(folder / "world_model")) != frozen:
        raise ValueError(f"the frozen world model of {folder} has changed; delete the folder and run again")
    return frozen


def _run_seeds(arguments: list[tuple]) -> None:
    """Two at a time, each in a process of its own; one alone in this one."""
    if len(arguments) == 1:
        return _train_and_evaluate(arguments[0])
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(2, mp_context=context, initializer=runs.start_worker) as pool:
            list(pool.map(_train_and_evaluate, arguments))
    except BrokenProcessPool as error:
        raise OSError("a policy's process died (of memory?); the same command goes on") from error


def _train_and_evaluate(arguments: tuple) -> None:
    """One policy seed: train, evaluate, and prove that the world model stayed as it was."""
    settings, folder, constants, seed, frozen = arguments
    torch.set_num_threads(1)
    runs.seed_everything(1000 + seed)
    world_model = modules.load_world_model(folder / "world_model").requires_grad_(False)
    policy = modules.make_policy(constants, settings.policy, world_model)
    features = TensorDict.load_memmap(folder / "features" / "train")
    held_out = TensorDict.load_memmap(folder / "features" / "eval")
    train_policy(policy, features, held_out, folder / f"seed_{seed}", settings, seed)
    modules.save_policy(folder / f"seed_{seed}" / "policy", policy, world_model)
    episodes = settings.test_episodes, settings.paper_episodes
    result = evaluate(world_model, policy, settings.task, *episodes, settings.split)
    result["world_model_sha256"] = fingerprint(world_model)
    if result["world_model_sha256"] != frozen:
        raise ValueError("the frozen world model has changed; this run is not valid")
    runs.write_json(folder / f"seed_{seed}" / "eval.json", result)
