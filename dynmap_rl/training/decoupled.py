"""Policies on a frozen world model, what decoupled training and generalisation share (paper, Sec. III-B and V-D).

The world model's states are computed once; every policy seed is then trained, and judged, in a process of its own,
and the weights of the world model are shown to be the same before and after.
"""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from dynmap_rl.data.features import compute_features
from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.evaluation.errors import policy_errors
from dynmap_rl.evaluation.protocol import evaluate
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import (
    load_policy,
    load_world_model,
    make_policy,
    save_policy,
    save_world_model,
)
from dynmap_rl.modules.world_model import WorldModel
from .policy import train_policy
from dynmap_rl.utils.devices import choose_device, seed_everything
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import run_processes
from dynmap_rl.utils.weights import fingerprint

TRAINED = "trained.json"  # written when a policy is: on which world model


def check_same(world_model: WorldModel, result: dict, folder: Path) -> None:
    """Raises ``ValueError`` where the result of a run was made with another world model."""
    if result["world_model_sha256"] != fingerprint(world_model):
        raise ValueError(f"{folder} was made with another world model; choose another --run, or delete it")


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
            ``copies`` and ``device``.
        seeds: of the policies.

    Returns:
        The fingerprint of the frozen world model.

    Raises:
        ValueError: the frozen weights have changed.
        OSError: a process died.
    """
    world_model.eval().requires_grad_(False)
    frozen = fingerprint(world_model)
    save_world_model(folder / "world_model", world_model)
    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    if todo:
        device = choose_device(settings.device)
        world_model.to(device)
        generator = torch.Generator(device).manual_seed(0)
        recolor = settings.task != NO_TASK
        features = compute_features(
            world_model, episodes["train"], settings.copies, generator, recolor=recolor
        )
        held_out = compute_features(world_model, episodes["eval"])
        shutil.rmtree(folder / "features", ignore_errors=True)  # of a killed run
        check_space(folder, features.bytes() + held_out.bytes())
        try:
            for name, values in (("train", features), ("eval", held_out)):
                values.cpu().memmap(folder / "features" / name)
            arguments = [(settings, folder, constants, seed, frozen) for seed in todo]
            run_processes([_train, _evaluate], arguments, settings.threads)
        finally:
            shutil.rmtree(folder / "features", ignore_errors=True)
    if fingerprint(load_world_model(folder / "world_model")) != frozen:
        raise ValueError(f"the frozen world model of {folder} has changed; delete the folder and run again")
    return frozen


def check_space(folder: Path, size: int) -> None:
    """Raises ``OSError`` where ``size`` bytes do not fit: a process that maps a file into memory would be killed."""
    if (free := shutil.disk_usage(folder).free) < size:
        raise OSError(errno.ENOSPC, f"{size / 1e6:.0f} MB are needed, {free / 1e6:.0f} are free", str(folder))


def _train(arguments: tuple) -> None:
    """One policy seed, unless it is trained already."""
    settings, folder, constants, seed, frozen = arguments
    path = folder / f"seed_{seed}"
    if (path / TRAINED).exists() and read_json(path / TRAINED) == {"world_model_sha256": frozen}:
        return
    torch.set_num_threads(1)
    seed_everything(1000 + seed)
    device = choose_device(settings.device)
    world_model = load_world_model(folder / "world_model")
    policy = make_policy(constants, settings.policy, world_model).to(device)
    features = TensorDict.load_memmap(folder / "features" / "train")
    held_out = TensorDict.load_memmap(folder / "features" / "eval")
    train_policy(policy, features, held_out, path, settings, seed)
    save_policy(path / "policy", policy, world_model)
    write_json(path / TRAINED, {"world_model_sha256": frozen})


def _evaluate(arguments: tuple) -> None:
    """Judge a trained policy, and prove that the world model stayed as it was."""
    settings, folder, _, seed, frozen = arguments
    torch.set_num_threads(1)
    seed_everything(1000 + seed)
    device = choose_device(settings.device)
    world_model = load_world_model(folder / "world_model").requires_grad_(False).to(device)
    policy = load_policy(folder / f"seed_{seed}" / "policy").to(device)
    if settings.task == NO_TASK:
        held_out = TensorDict.load_memmap(folder / "features" / "eval")
        result = {"held_out": policy_errors(policy, held_out)}
    else:
        episodes = settings.test_episodes, settings.paper_episodes
        result = evaluate(Actor(world_model, policy, mixed=True), settings.task, *episodes, settings.split)
    result["world_model_sha256"] = fingerprint(world_model)
    if result["world_model_sha256"] != frozen:
        raise ValueError("the frozen world model has changed; this run is not valid")
    write_json(folder / f"seed_{seed}" / "eval.json", result)
