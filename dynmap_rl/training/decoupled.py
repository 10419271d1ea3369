"""Policies on a frozen world model, for decoupled training and generalisation (paper, Sec. III-B and V-C).

The world model's states are computed once. Every policy is then trained, and judged, in a process of its own. The
fingerprint of the world model is the same before and after.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.features import compute_features
from dynmap_rl.data.settings import Augmentation
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.modules.checkpoints import (
    load_policy,
    load_world_model,
    make_policy,
    save_policy,
    save_world_model,
)
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.runs.folder import compare_settings, plain_settings
from dynmap_rl.utils.devices import Compute, choose_device, seed_everything
from dynmap_rl.utils.files import check_space, read_json, write_json
from dynmap_rl.utils.processes import run_processes
from dynmap_rl.utils.weights import fingerprint

from .dagger import add_corrections, check_corrections
from .dataset import choose_augmentation
from .policy import train_policy
from .settings import PolicyTraining

TRAINED = "trained.json"  # fingerprint of the world model, and settings; written after a policy's training
Judge = Callable[[WorldModel, nn.Module], dict]


def check_copies(settings: PolicyTraining, task: str | None) -> None:
    """Raise ``ValueError`` for augmented copies where the episodes are not of a task in the plane."""
    if settings.copies and not (task and get_task(task).planar):
        raise ValueError(
            f"PolicyTraining.copies need a task in the plane, such as balance_reaching, got {task}; use 0 copies"
        )


def check_same(world_model: WorldModel, result: dict, folder: Path) -> None:
    """Raise ``ValueError`` if the result of a run was obtained with another world model."""
    if result["world_model_sha256"] != fingerprint(world_model):
        raise ValueError(
            f"{folder} was made with another world model; choose another --run, or delete the folder"
        )


def train_policies(
    world_model: WorldModel,
    episodes: dict[str, TensorDictBase],
    constants: dict,
    folder: Path,
    settings: PolicyTraining | None = None,
    *,
    judge: Judge,
    task: str | None = None,
    seeds: Sequence[int] = (0, 1, 2),
    compute: Compute | None = None,
    logger: str | None = None,
) -> str:
    """Freeze a world model; train and judge a policy for every seed that ``folder`` does not hold yet.

    Args:
        world_model: frozen, set to evaluation and moved to the device; its weights stay as they are.
        episodes: ``train`` and ``eval``, TensorDicts ``[E, T]``.
        constants: of the dataset's normalisation.
        folder: run folder; gets ``world_model`` and ``seed_N`` with ``policy``, ``metrics.jsonl``, ``eval.json``.
        settings: of the policies' training; default :class:`PolicyTraining`.
        judge: function of world model and policy to the content of ``eval.json``. With more than one thread it must
            be picklable, such as a ``functools.partial`` of
            :func:`dynmap_rl.evaluation.protocol.judge_in_closed_loop`.
        task: name of the task, whose scenes say how copies may change, and whose expert gives corrections.
        seeds: seeds of the policies.
        compute: device, and policies trained at a time.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.

    Returns:
        The fingerprint of the frozen world model.

    Raises:
        ValueError: the frozen weights have changed, ``folder`` has policies with other settings or on another world
            model, corrections are wanted and there is no expert, or copies and there is no task in the plane.
        OSError: a process died, or the disk is full.
    """
    settings, compute, folder = settings or PolicyTraining(), compute or Compute(), Path(folder)
    check_corrections(settings, task, seeds)
    check_copies(settings, task)
    for path in (folder / f"seed_{seed}" / TRAINED for seed in seeds):
        if path.exists() and compare_settings(
            read_json(path).get("settings", plain_settings(settings)), settings
        ):
            raise ValueError(f"{path.parent} holds a policy with other settings; choose another folder")
    world_model.eval().requires_grad_(False)
    frozen = fingerprint(world_model)
    for path in folder.glob("seed_*/eval.json"):
        check_same(world_model, read_json(path), path.parent)
    save_world_model(folder / "world_model", world_model)
    if todo := [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]:
        work = _Work(folder, constants, settings, judge, task, compute.device, logger, frozen)
        states = folder / "features"
        shutil.rmtree(states, ignore_errors=True)  # left behind by a kill
        try:
            _write_features(world_model, episodes, states, compute.device, settings.copies, task)
            run_processes([_train, _evaluate], [(work, seed) for seed in todo], compute.threads)
        finally:
            shutil.rmtree(states, ignore_errors=True)
    if fingerprint(load_world_model(folder / "world_model")) != frozen:
        raise ValueError(f"the frozen world model of {folder} has changed; delete the folder and run again")
    return frozen


@dataclass(frozen=True)
class _Work:
    """What every seed shares, for processes of their own."""

    folder: Path
    constants: dict
    settings: PolicyTraining
    judge: Judge
    task: str | None
    device: str
    logger: str | None
    frozen: str


def _write_features(
    world_model, episodes, states: Path, device: str, copies: int = 0, task: str | None = None
) -> None:
    world_model.to(choose_device(device))
    train, held_out = (compute_features(world_model, episodes[split]) for split in ("train", "eval"))
    check_space(states.parent, train.bytes() * (1 + copies) + held_out.bytes())
    if copies:
        augmentation = choose_augmentation(get_task(task), Augmentation(), imitated=True)
        change = partial(augment, generator=torch.Generator().manual_seed(0), settings=augmentation)
        more = (compute_features(world_model, episodes["train"], change=change).cpu() for _ in range(copies))
        train = torch.cat([train.cpu(), *more])
    for name, values in (("train", train), ("eval", held_out)):
        values.cpu().memmap(states / name)


def _train(arguments: tuple[_Work, int]) -> None:
    """Train the policy of a seed, unless it is trained already."""
    work, seed = arguments
    path = work.folder / f"seed_{seed}"
    if (path / TRAINED).exists() and read_json(path / TRAINED)["world_model_sha256"] == work.frozen:
        return
    torch.set_num_threads(1)
    seed_everything(1000 + seed)
    world_model = load_world_model(work.folder / "world_model")
    policy = make_policy(work.constants, work.settings.kind, world_model).to(choose_device(work.device))
    states = [TensorDict.load_memmap(work.folder / "features" / name) for name in ("train", "eval")]
    train_policy(policy, *states, path, work.settings, seed=seed, logger=work.logger)
    if work.settings.corrections:
        world_model.requires_grad_(False).to(next(policy.parameters()).device)
        states[0] = add_corrections(
            states[0], world_model, policy, work.task, work.settings.corrections, seed
        )
        more = replace(work.settings, updates=work.settings.correction_updates)
        train_policy(policy, *states, path, more, seed=seed, done=work.settings.updates, logger=work.logger)
    save_policy(path / "policy", policy, world_model)
    trained = {"world_model_sha256": work.frozen, "settings": plain_settings(work.settings)}
    write_json(path / TRAINED, trained)


def _evaluate(arguments: tuple[_Work, int]) -> None:
    """Judge a trained policy, and check that the world model has not changed."""
    work, seed = arguments
    torch.set_num_threads(1)
    seed_everything(1000 + seed)
    device = choose_device(work.device)
    world_model = load_world_model(work.folder / "world_model").requires_grad_(False).to(device)
    policy = load_policy(work.folder / f"seed_{seed}" / "policy").to(device)
    result = work.judge(world_model, policy) | {"world_model_sha256": fingerprint(world_model)}
    if result["world_model_sha256"] != work.frozen:
        raise ValueError("the frozen world model has changed; this run is not valid")
    write_json(work.folder / f"seed_{seed}" / "eval.json", result)
