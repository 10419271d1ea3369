"""Training loops that the recipes share: the world model alone, and a policy on a frozen world model's states."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from dynmap_rl.data.augmentation import add_distractors, augment
from dynmap_rl.data.windows import sample_windows
from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.runs.folder import load_training_state, save_training_state, truncate_metrics
from dynmap_rl.runs.loggers import log_metrics
from .parallel import differentiate, map_in_threads, split_batch

ADVICE = "what was kept before stays; run again with a lower learning rate, in another --run"


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
    if state := load_training_state(path):
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        start, first = state["update"], state.get("first_loss")
        _restore(generators, state.get("generators", []), start)
    truncate_metrics(folder, start)
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
                save_training_state(
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
