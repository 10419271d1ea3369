"""Training loops that the recipes share: the world model alone, and a policy on a frozen world model's states."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from dynmap_rl import runs
from dynmap_rl.data import add_distractors, augment, compute_features, sample_windows
from dynmap_rl.envs.tasks import NO_TASK, get_task
from dynmap_rl.loggers import log_metrics
from dynmap_rl.modules import WorldModel, mixed_precision
from dynmap_rl.objectives import ImitationLoss, JointLoss, WorldModelLoss
from dynmap_rl.parts import differentiate, map_in_threads, split_batch

ADVICE = "what was kept before stays; run again with a lower learning rate, in another --run"
GROUPS = {"": [0, 1, 3, 4], "_angle": [2, 5]}  # entries of our tasks' dynamics that have one unit


def train_world_model(
    world_model: WorldModel,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings,
    save_every: int = 250,
) -> None:
    """Minimise Eq. 4a plus Eq. 5 on augmented windows; a stopped run goes on from its last training state.

    Args:
        world_model: changed in place.
        episodes: ``train`` and ``eval``, ``[E, T]``.
        folder: run folder; gets ``metrics.jsonl`` and the training state.
        settings: with ``updates``, ``windows``, ``window_steps``, ``rgb_steps``, ``distractors``,
            ``learning_rate``, ``beta_z``, ``beta_dynamics`` and ``world_model_seed``. Windows are as they are where its
            ``task`` is none: what may be changed in the frames of others is not known.

    Raises:
        ValueError: the loss is not finite or diverges; the last training state, from before, is kept.
    """

    def held_out() -> dict[str, float]:
        return prediction_errors(world_model, episodes["eval"], by_entry=_has_no_task(settings))

    _fit(
        world_model,
        lambda generator: _make_loss(world_model, settings, generator),
        episodes["train"],
        held_out,
        folder,
        settings,
        settings.world_model_seed,
        save_every,
    )


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


def _has_no_task(settings) -> bool:
    return getattr(settings, "task", None) == NO_TASK


def _make_loss(world_model: WorldModel, settings, generator: torch.Generator) -> WorldModelLoss:
    weights = settings.beta_z, settings.beta_dynamics
    return WorldModelLoss(world_model, *weights, rgb_steps=settings.rgb_steps, generator=generator)


def _fit(
    model: nn.Module,
    make_loss: Callable[[torch.Generator], nn.Module],
    episodes: TensorDictBase,
    held_out: Callable[[], dict[str, float]],
    folder: Path,
    settings,
    seed: int,
    save_every: int,
    limits: dict | None = None,
) -> None:
    """The loop over windows; ``limits`` are those of the augmentation. Every part of a batch has a generator of its own
    (see :mod:`dynmap_rl.parts`), which also draws what its loss has to draw."""
    device = next(model.parameters()).device
    model.to(memory_format=torch.channels_last)  # with bfloat16 six times faster on a CPU
    optimizer = make_optimizer(model, settings.learning_rate, weight_decay=1e-4)
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    episodes = episodes.select("pixels", "action", "goal", "dynamics", "disturbed", strict=False).to(device)
    sizes = split_batch(settings.windows, device)
    generators = [torch.Generator(device).manual_seed(1000 * seed + part) for part in range(len(sizes))]
    loss_modules = [make_loss(generator) for generator in generators]

    def find_losses(part: int) -> dict[str, torch.Tensor]:
        windows = _draw_windows(episodes, sizes[part], settings, generators[part], limits or {})
        with mixed_precision(device):
            losses = loss_modules[part](windows)
        return {name: value * (sizes[part] / settings.windows) for name, value in losses.items()}

    start, first, path = 0, None, folder / "checkpoint" / "world_model.pt"
    if state := runs.load_training_state(path):
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        start, first = state["update"], state.get("first_loss")
        _restore(generators, state.get("generators", []), start)
    runs.truncate_metrics(folder, start)
    progress = tqdm(range(start, settings.updates), folder.name, settings.updates, initial=start)
    with map_in_threads(len(sizes)) as map_parts:
        for update in progress:
            set_learning_rate(optimizer, settings.learning_rate, update, settings.updates)
            losses = differentiate(find_losses, range(len(sizes)), parameters, map_parts)
            norm = descend(optimizer)
            done = update + 1
            saved = done % save_every == 0 or done == settings.updates
            if saved or done % 50 == 0 or done == 1:
                losses = {name: value.item() for name, value in losses.items()}
                first = check_loss(sum(losses.values()), norm, first)
                progress.set_postfix({k.removeprefix("loss_"): f"{v:.3f}" for k, v in losses.items()})
            if saved:
                log_metrics(folder, done, settings.logger, **losses, **held_out())
                runs.save_training_state(
                    path,
                    model=model.state_dict(),
                    optimizer=optimizer.state_dict(),
                    generators=[generator.get_state() for generator in generators],
                    update=done,
                    first_loss=first,
                )


def _draw_windows(episodes, size: int, settings, generator: torch.Generator, limits: dict) -> TensorDictBase:
    windows = sample_windows(episodes, size, settings.window_steps, generator)
    if not _has_no_task(settings):
        windows = augment(windows, generator, **limits)
    return add_distractors(windows, generator, settings.distractors)


def _restore(generators: list[torch.Generator], states: list[torch.Tensor], update: int) -> None:
    """Their states, or, where these are of another kind of device or of an earlier release, new ones."""
    shapes = [generator.get_state().shape for generator in generators]
    for part, generator in enumerate(generators):
        if [state.shape for state in states] == shapes:
            generator.set_state(states[part])
        else:
            generator.manual_seed(generator.initial_seed() + 1_000_000 * update)


def train_policy(
    policy: nn.Module, features: TensorDictBase, held_out: TensorDictBase, folder: Path, settings, seed: int
) -> None:
    """Minimise the L1 imitation loss on precomputed states ``[E, T]`` (the world model is not even here).

    Args:
        policy: changed in place.
        features, held_out: what :func:`dynmap_rl.data.compute_features` gave.
        folder: gets ``metrics.jsonl``.
        settings: with ``policy_updates``, ``policy_batch``, ``policy_learning_rate`` and ``emphasis``.
        seed: of the batches; also the progress bar's line.
    """
    folder.mkdir(parents=True, exist_ok=True)
    runs.truncate_metrics(folder, 0)
    optimizer = make_optimizer(policy, settings.policy_learning_rate, weight_decay=1e-3)
    device = next(policy.parameters()).device
    features, held_out = features.to(device), held_out.to(device)
    generator = torch.Generator(device).manual_seed(seed)
    loss_module, plain = ImitationLoss(policy, settings.emphasis), ImitationLoss(policy)
    progress, first = tqdm(range(settings.policy_updates), f"policy {seed}", position=seed), None
    for update in progress:
        set_learning_rate(optimizer, settings.policy_learning_rate, update, settings.policy_updates)
        index = torch.randint(len(features), (settings.policy_batch,), generator=generator, device=device)
        batch = features[index]
        with mixed_precision(device):
            loss = loss_module(batch)["loss_policy"]
        norm = step(loss, optimizer)
        done = update + 1
        if done % 100 == 0 or done in (1, settings.policy_updates):
            first = check_loss(loss.item(), norm, first)
        if done % 100 == 0 or done == settings.policy_updates:
            with torch.no_grad():
                validation = plain(held_out)["loss_policy"]
            log_metrics(folder, done, settings.logger, loss=loss.item(), held_out_loss=validation)
            progress.set_postfix(loss=f"{loss:.4f}", held_out=f"{validation:.4f}")


@torch.no_grad()
def prediction_errors(
    world_model: WorldModel, episodes: TensorDictBase, batch: int = 10, by_entry: bool = False
) -> dict[str, float]:
    """One-step prediction errors on episodes ``[E, T]``: the frames' root mean square (0..1), and the mean absolute
    error of each decoded quantity's x and y (m, m/s, m/s^2) and of its angles (``_angle``: rad, rad/s, rad/s^2), or,
    ``by_entry``, of each of its entries (``_0``, ``_1``, ...)."""
    sums: dict[str, float] = {}
    device = next(world_model.parameters()).device
    for chunk in episodes.split(batch):
        chunk = chunk.to(device)
        states = world_model.predict(world_model.encode(chunk["pixels"], mixed=True), chunk["action"])
        some = [s[:, 1::10] for s in states]  # a tenth of the frames is enough
        error = world_model.decode_pixels(*some) - chunk["pixels"][:, 1::10] / 255
        errors = {"rgb": error.square().flatten(2).mean(-1).sqrt().mean()}
        for name, value in world_model.decode_dynamics(*states).items():
            difference = (value - chunk["dynamics", name])[:, 1:].abs()
            groups = {f"_{i}": [i] for i in range(difference.shape[-1])} if by_entry else GROUPS
            for group, entries in groups.items():
                errors[f"{name}{group}"] = difference[..., entries].mean()
        for name, value in errors.items():
            sums[f"error_{name}"] = sums.get(f"error_{name}", 0.0) + value.item() * len(chunk) / len(episodes)
    return sums


@torch.no_grad()
def policy_error(world_model: WorldModel, policy: nn.Module, episodes: TensorDictBase) -> float:
    """The plain L1 loss of a policy on episodes ``[E, T]``."""
    return ImitationLoss(policy)(compute_features(world_model, episodes))["loss_policy"].item()


def make_optimizer(module: nn.Module, learning_rate: float, weight_decay: float) -> torch.optim.Optimizer:
    """AdamW as all our trainings have it."""
    return torch.optim.AdamW(
        module.parameters(), learning_rate, betas=(0.9, 0.99), weight_decay=weight_decay, fused=True
    )


def set_learning_rate(optimizer, peak: float, update: int, updates: int) -> None:
    """100 steps of warm-up, then a cosine to 2 % of the peak."""
    factor = min(1.0, (update + 1) / 100) * (0.51 + 0.49 * math.cos(math.pi * update / updates))
    for group in optimizer.param_groups:
        group["lr"] = peak * factor


def step(loss: torch.Tensor, optimizer) -> torch.Tensor:
    """One optimiser step with clipped gradients; their norm. Nothing in it waits for an accelerator."""
    optimizer.zero_grad()
    loss.backward()
    return descend(optimizer)


def descend(optimizer) -> torch.Tensor:
    """:func:`step` by the gradients that are there."""
    norm = nn.utils.clip_grad_norm_([p for g in optimizer.param_groups for p in g["params"]], 1.0)
    optimizer.step()
    return norm


def check_loss(loss: float, norm: torch.Tensor, first: float | None = None) -> float:
    """The run's first loss, or this one where it is the first.

    Raises:
        ValueError: the loss or the gradients' norm is not finite, or the loss is ten times what it was at first.
    """
    if not (math.isfinite(loss) and norm.isfinite()):
        raise ValueError(f"the loss is not finite; {ADVICE}")
    if first is not None and loss > 10 * first:
        raise ValueError(f"the loss diverges ({loss:.3g}, at first {first:.3g}); {ADVICE}")
    return loss if first is None else first
