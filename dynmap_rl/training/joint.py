"""Joint and end-to-end training of world model and policy (paper, Sec. III-B)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from dynmap_rl.data.features import compute_features
from dynmap_rl.evaluation.errors import policy_errors, prediction_errors
from dynmap_rl.modules.checkpoints import load_world_model, make_policy, save_policy, save_world_model
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.runs.folder import compare_settings, plain_settings
from dynmap_rl.utils.devices import Compute, choose_device, seed_everything
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import run_processes
from dynmap_rl.utils.ranks import rank, ranks
from dynmap_rl.utils.weights import fingerprint

from .decoupled import TRAINED, Judge
from .loop import SAVE_EVERY, fit
from .settings import EndToEndTraining, JointTraining, PolicyArchitecture, WorldModelArchitecture
from .world_model import build_world_model, make_loss

Load = Callable[[], tuple[dict[str, TensorDictBase], dict]]


def train_jointly(
    world_model: WorldModel,
    policy: nn.Module,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings: JointTraining | None = None,
    *,
    seed: int = 0,
    logger: str | None = None,
    by_entry: bool = False,
    save_every: int = SAVE_EVERY,
) -> None:
    """Minimise Eq. 4 with the terms of Eq. 5 on augmented windows; a stopped run resumes.

    The policy learns from the augmented windows too: mirror and shift only where the task is symmetric
    (``settings.augmentation``).

    Args:
        world_model: changed in place.
        policy: changed in place.
        episodes: ``train`` and ``eval``, ``[E, T]`` with ``pixels`` uint8 ``[E, T, 3, S, cameras * S]``, ``action`` ``[E, T, A]``,
            ``goal`` ``[E, T, G]`` and ``("dynamics", quantity)`` ``[E, T, D]`` (SI units) for each supervised quantity.
        folder: gets ``metrics.jsonl`` and the training state.
        settings: sizes, weights and learning rate; default :class:`JointTraining`.
        seed: seed of the windows.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.
        by_entry: see :func:`dynmap_rl.training.train_world_model`.
        save_every: updates between training states.

    Raises:
        ValueError: the loss is not finite or diverges; the last training state is kept.
    """
    settings = settings or JointTraining()

    def make(generator: torch.Generator) -> JointLoss:
        of_world_model = make_loss(world_model, settings, generator)
        return JointLoss(of_world_model, policy, settings.beta_joint, settings.emphasis)

    def held_out() -> dict[str, float]:
        errors = prediction_errors(world_model, episodes["eval"], by_entry=by_entry)
        return errors | _policy_loss(world_model, policy, episodes["eval"])

    model = nn.ModuleDict({"world_model": world_model, "policy": policy})
    fit(model, make, episodes["train"], held_out, folder, settings, seed, logger, save_every)


def train_end_to_end(
    world_model: WorldModel,
    policy: nn.Module,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings: EndToEndTraining | None = None,
    *,
    seed: int = 0,
    logger: str | None = None,
    save_every: int = SAVE_EVERY,
) -> None:
    """Minimise Eq. 3, the policy's loss alone, through encoder and transition; a stopped run resumes.

    Args:
        world_model: changed in place; its decoders are not trained.
        policy: changed in place.
        episodes: ``train`` and ``eval``, ``[E, T]`` with ``pixels`` uint8 ``[E, T, 3, S, cameras * S]``, ``action`` ``[E, T, A]``,
            ``goal`` ``[E, T, G]`` and ``("dynamics", quantity)`` ``[E, T, D]`` (SI units) for each supervised quantity.
        folder: gets ``metrics.jsonl`` and the training state.
        settings: sizes and learning rate; default :class:`EndToEndTraining`.
        seed: seed of the windows.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.
        save_every: updates between training states.

    Raises:
        ValueError: the loss is not finite or diverges; the last training state is kept.
    """
    settings = settings or EndToEndTraining()

    def make(generator: torch.Generator) -> JointLoss:
        of_world_model = WorldModelLoss(world_model, distributed=True)
        return JointLoss(of_world_model, policy, 1.0, settings.emphasis, end_to_end=True)

    def held_out() -> dict[str, float]:
        return _policy_loss(world_model, policy, episodes["eval"])

    model = nn.ModuleDict({"world_model": world_model, "policy": policy})
    fit(model, make, episodes["train"], held_out, folder, settings, seed, logger, save_every)


def _policy_loss(world_model: WorldModel, policy: nn.Module, episodes: TensorDictBase) -> dict[str, float]:
    errors = policy_errors(policy, compute_features(world_model, episodes))
    return {"held_out_loss": errors["imitation_l1"]}


@dataclass(frozen=True)
class _Work:
    """What every seed shares, for processes of their own."""

    load: Load
    folder: Path
    world_model: WorldModelArchitecture
    policy: PolicyArchitecture
    settings: EndToEndTraining
    judge: Judge
    device: str
    threads: int
    logger: str | None
    by_entry: bool


def train_seeds(
    load: Load,
    folder: Path,
    world_model: WorldModelArchitecture,
    policy: PolicyArchitecture,
    settings: EndToEndTraining,
    *,
    judge: Judge,
    seeds: Sequence[int] = (0, 1, 2),
    compute: Compute | None = None,
    logger: str | None = None,
    by_entry: bool = False,
) -> WorldModel | None:
    """Train and judge a world model with its policy for every seed that ``folder`` does not hold yet.

    Args:
        load: picklable function that returns the episodes (``train`` and ``eval``) and the constants of normalisation,
            such as a ``functools.partial`` of :func:`dynmap_rl.data.demonstrations.load_demonstrations`.
        folder: run folder; gets ``seed_N`` with ``world_model``, ``policy``, ``metrics.jsonl``, ``eval.json``, and
            the first seed's world model as ``world_model``.
        world_model: form of the world models.
        policy: form of the policies.
        settings: :class:`JointTraining`, or :class:`EndToEndTraining` for the policy's loss alone.
        judge: see :func:`dynmap_rl.training.train_policies`.
        seeds: seeds of world models and policies.
        compute: device, and seeds trained at a time.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.
        by_entry: see :func:`dynmap_rl.training.train_world_model`.

    Returns:
        The first seed's world model; None in all but the first of several processes that train together.

    Raises:
        ValueError: ``folder`` has seeds that were trained with other settings.
        OSError: a process died.
    """
    compute, folder = compute or Compute(), Path(folder)
    form = _name_settings(world_model, policy, settings)
    for path in (folder / f"seed_{seed}" / TRAINED for seed in seeds):
        if path.exists() and _differs(read_json(path), form):
            raise ValueError(f"{path.parent} was trained with other settings; choose another folder")
    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    threads = compute.threads if len(seeds) == 1 or ranks() > 1 else 1
    work = _Work(
        load, folder, world_model, policy, settings, judge, compute.device, threads, logger, by_entry
    )
    # Processes that train together train one seed after the other.
    workers = compute.threads if ranks() == 1 else 1
    run_processes([_train_and_evaluate], [(work, seed) for seed in todo], workers)
    if rank():
        return None
    first = load_world_model(folder / f"seed_{seeds[0]}" / "world_model")
    save_world_model(folder / "world_model", first)
    return first


def _name_settings(world_model, policy, settings) -> dict:
    return {"world_model": world_model, "policy": policy, type(settings).__name__: settings}


def _differs(stored: dict, form: dict) -> bool:
    return set(stored) != set(form) or any(compare_settings(stored[name], form[name]) for name in form)


def _train_and_evaluate(arguments: tuple[_Work, int]) -> None:
    work, seed = arguments
    torch.set_num_threads(work.threads)
    seed_everything(2000 + seed)
    episodes, constants = work.load()
    device = choose_device(work.device)
    world_model = build_world_model(constants, work.world_model, episodes["train"]).to(device)
    policy = make_policy(constants, work.policy.kind, world_model).to(device)
    folder = work.folder / f"seed_{seed}"
    common = {"seed": seed, "logger": work.logger}
    if isinstance(work.settings, JointTraining):
        common["by_entry"] = work.by_entry
        train_jointly(world_model, policy, episodes, folder, work.settings, **common)
    else:
        train_end_to_end(world_model, policy, episodes, folder, work.settings, **common)
    if rank():
        return
    world_model.eval(), policy.eval()
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "policy", policy, world_model)
    form = _name_settings(work.world_model, work.policy, work.settings)
    write_json(folder / TRAINED, {name: plain_settings(value) for name, value in form.items()})
    torch.set_num_threads(1)
    result = work.judge(world_model, policy)
    write_json(folder / "eval.json", result | {"world_model_sha256": fingerprint(world_model)})
