"""World model and policy trained as one, what joint and end-to-end training share (paper, Sec. III-B)."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from dynmap_rl.data.features import compute_features
from dynmap_rl.envs.tasks import NO_TASK, get_task
from dynmap_rl.evaluation.errors import policy_error, policy_errors, prediction_errors
from dynmap_rl.evaluation.protocol import evaluate
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model, save_policy, save_world_model
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss
from .dataset import load_episodes
from .loop import _fit, _has_no_task, _make_loss
from dynmap_rl.utils.devices import choose_device, seed_everything
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.processes import run_processes
from dynmap_rl.utils.weights import fingerprint


def train_seeds(
    dataset: str | Path,
    supervision: tuple[str, ...],
    folder: Path,
    settings,
    seeds: list[int],
    end_to_end: bool = False,
) -> None:
    """Train and judge a world model with its policy for every seed that ``folder`` does not hold yet.

    Args:
        dataset: a folder or a hub id.
        supervision: of the world model.
        folder: run folder; gets ``seed_N`` with ``world_model``, ``policy``, ``metrics.jsonl``, ``eval.json``.
        settings: see :func:`dynmap_rl.training.train_jointly`; also with ``policy``, ``device``, ``split``,
            ``test_episodes`` and ``paper_episodes``.
        seeds: of world model and policy.
        end_to_end: minimise the policy's loss alone.

    Raises:
        OSError: a process died.
    """
    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    arguments = [(dataset, supervision, folder, settings, seed, end_to_end) for seed in todo]
    run_processes([_train_and_evaluate], arguments, settings.threads)


def _train_and_evaluate(arguments: tuple) -> None:
    dataset, supervision, folder, settings, seed, end_to_end = arguments
    torch.set_num_threads(1)
    seed_everything(2000 + seed)
    episodes, constants = load_episodes(settings, dataset)
    device = choose_device(settings.device)
    world_model = make_world_model(constants, supervision).to(device)
    policy = make_policy(constants, settings.policy, world_model).to(device)
    folder = folder / f"seed_{seed}"
    train_jointly(world_model, policy, episodes, folder, settings, seed, end_to_end)
    world_model.eval(), policy.eval()
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "policy", policy, world_model)
    if settings.task == NO_TASK:
        features = compute_features(world_model, episodes["eval"])
        errors = prediction_errors(world_model, episodes["eval"], by_entry=True)
        result = {"held_out": errors | policy_errors(policy, features)}
    else:
        sizes = settings.test_episodes, settings.paper_episodes
        result = evaluate(Actor(world_model, policy, mixed=True), settings.task, *sizes, settings.split)
    write_json(folder / "eval.json", result | {"world_model_sha256": fingerprint(world_model)})


def train_jointly(
    world_model: WorldModel,
    policy: nn.Module,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings,
    seed: int,
    end_to_end: bool = False,
    save_every: int = 250,
) -> None:
    """Minimise Eq. 4 with the terms of Eq. 5, or, end to end, Eq. 3, in the manner of :func:`train_world_model`.

    Windows are mirrored and shifted only where the task is ``symmetric``: the policy learns from them too.

    Args:
        world_model, policy: changed in place.
        settings: also with ``task``, ``beta_joint`` and ``emphasis``; end to end without those of the world model's
            losses.
        seed: of the windows.
        end_to_end: the policy's loss alone.
    """
    model = nn.ModuleDict({"world_model": world_model, "policy": policy})

    def make_loss(generator: torch.Generator) -> JointLoss:
        if end_to_end:
            return JointLoss(WorldModelLoss(world_model), policy, 1.0, settings.emphasis, end_to_end=True)
        of_world_model = _make_loss(world_model, settings, generator)
        return JointLoss(of_world_model, policy, settings.beta_joint, settings.emphasis)

    def held_out() -> dict[str, float]:
        errors = {}
        if not end_to_end:
            errors = prediction_errors(world_model, episodes["eval"], by_entry=_has_no_task(settings))
        return errors | {"held_out_loss": policy_error(world_model, policy, episodes["eval"])}

    symmetric = not _has_no_task(settings) and get_task(settings.task).symmetric
    limits = {} if symmetric else {"max_shift": 0, "mirror": False}
    _fit(model, make_loss, episodes["train"], held_out, folder, settings, seed, save_every, limits)
