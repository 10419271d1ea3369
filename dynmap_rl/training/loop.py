"""The loop over windows that every world-model training shares, and its optimiser."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.windows import check_length, sample_windows
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.runs.folder import (
    load_training_state,
    plain_settings,
    save_training_state,
    truncate_metrics,
)
from dynmap_rl.runs.loggers import log_metrics
from dynmap_rl.utils.ranks import mean_over_ranks, rank, ranks, translate_errors
from dynmap_rl.utils.settings import flatten

from .settings import EndToEndTraining, WorldModelTraining, windows_at

ADVICE = "the last saved state is kept; run again with a lower learning rate, in another --run"
SAVE_EVERY = 250  # updates
SAVE_AFTER = 60  # seconds, in a single process; several would not agree


@translate_errors()
def fit(
    model: nn.Module,
    make_loss: Callable[[torch.Generator], nn.Module],
    episodes: TensorDictBase,
    held_out: Callable[[], dict[str, float]],
    folder: Path,
    settings: WorldModelTraining | EndToEndTraining,
    seed: int,
    logger: str | None = None,
    save_every: int = SAVE_EVERY,
) -> None:
    """Minimise a loss on random windows of episodes; a stopped run resumes from its last training state.

    Under ``torchrun`` or Ray Train, every process trains on its part of each batch, and the first one writes. A run may
    resume with another number of processes.

    Args:
        model: all that is trained, changed in place.
        make_loss: function that makes the loss module from the generator of its random numbers.
        episodes: training episodes ``[E, T]``.
        held_out: metrics to log beside the losses.
        folder: run folder; gets ``metrics.jsonl`` and the training state.
        settings: sizes, augmentation and learning rate.
        seed: seed of the windows.
        logger: see :func:`dynmap_rl.runs.loggers.log_metrics`.
        save_every: updates between training states, which a single process also saves after a minute.

    Raises:
        ValueError: the loss is not finite or diverges, a batch cannot be divided among the processes, or the folder
            holds a training with other settings, of another model or on other data; the last training state is kept.
        OSError: another process has ended.
    """
    for update in (0, settings.updates - 1):
        batch, length = windows_at(settings, update)
        if batch % ranks():
            raise ValueError(
                f"windows of a batch must be a multiple of {ranks()} processes, got {batch} of {length} steps"
            )
        check_length(length, episodes.shape[1])
    folder = Path(folder)
    device = next(model.parameters()).device
    model.to(memory_format=torch.channels_last)  # with bfloat16 six times faster on a CPU
    optimizer = make_optimizer(model, settings.learning_rate, weight_decay=1e-4)
    episodes = episodes.select(
        *("pixels", "action", "goal", "dynamics", "disturbed", "expert_action", "labelled", "step_count"),
        strict=False,
    )
    data = _hash_labels(episodes)
    if device.type == "cuda" and episodes.bytes() < torch.cuda.mem_get_info(device)[0] / 2:
        episodes = episodes.to(device)  # larger ones stay on disk
    generator = torch.Generator(device).manual_seed(1000 * seed)
    # What a rank draws beside the windows of the whole batch, by which all stay in step.
    own = generator if ranks() == 1 else torch.Generator(device)
    loss_module = make_loss(own)
    start, first, path = 0, None, folder / "checkpoint" / "world_model.pt"
    # A training may go on for more updates.
    one = replace(settings, updates=1)
    form = plain_settings(one) | {"seed": seed}
    if state := load_training_state(path):
        # Older trainings lack settings that are younger; these have their defaults.
        stored = flatten(plain_settings(type(one)())) | flatten(state.get("form", form))
        if stored != flatten(form) or state["update"] > settings.updates:
            raise ValueError(f"{folder} holds a training with other settings; choose another folder")
        if state.get("data", data) != data:
            raise ValueError(f"{folder} holds a training on other episodes; choose another folder")
        try:
            model.load_state_dict(state["model"])
        except RuntimeError as error:
            raise ValueError(f"{folder} holds a training of another model; choose another folder") from error
        optimizer.load_state_dict(state["optimizer"])
        start, first = state["update"], state["first_loss"]
        _restore(generator, state["generator"], start)
    if not rank():
        truncate_metrics(folder, start)
    unused = type(settings) is EndToEndTraining or not getattr(settings, "beta_rgb", 1)  # decoders
    loss_module = share_gradients(loss_module, some=unused)
    part = slice(rank(), None, ranks())
    bar = {"initial": start} | ({"disable": True} if rank() else {})  # False would override TQDM_DISABLE
    progress = tqdm(range(start, settings.updates), folder.name, settings.updates, **bar)
    clock = time.monotonic()
    for update in progress:
        set_learning_rate(optimizer, settings.learning_rate, update, settings.updates)
        batch, length = windows_at(settings, update)
        windows = sample_windows(episodes, batch, length, generator, part).to(device)
        if own is not generator:
            own.manual_seed(int(np.random.SeedSequence((seed, update, rank())).generate_state(1)[0]))
        windows = augment(windows, own, settings.augmentation)
        with mixed_precision(device):
            losses = loss_module(windows)
        norm = step(sum(losses.values()), optimizer)
        done = update + 1
        logged = done % save_every == 0 or done == settings.updates
        saved = logged or (ranks() == 1 and time.monotonic() - clock > SAVE_AFTER)
        if saved or done % 50 == 0 or done == 1:
            losses = {name: mean_over_ranks(value).item() for name, value in losses.items()}
            first = check_loss(sum(losses.values()), norm, first)
            progress.set_postfix({k.removeprefix("loss_"): f"{v:.3f}" for k, v in losses.items()})
        if logged and not rank():
            log_metrics(folder, done, logger, **losses, **held_out())
        if saved and not rank():
            save_training_state(
                path,
                model=model.state_dict(),
                optimizer=optimizer.state_dict(),
                generator=generator.get_state(),
                update=done,
                first_loss=first,
                form=form,
                data=data,
            )
            clock = time.monotonic()


def _hash_labels(episodes: TensorDictBase) -> str:
    """Return a hash of actions and dynamics, which are small and tell sources of dynamics apart."""
    digest = hashlib.sha256()
    for key in sorted(episodes.select("action", "dynamics", strict=False).keys(True, True), key=str):
        digest.update(episodes[key].cpu().numpy().tobytes())
    return digest.hexdigest()[:16]


class _Losses(nn.Module):
    """Loss module with a dict for its result, in which DistributedDataParallel finds the tensors."""

    def __init__(self, module: nn.Module):
        super().__init__()
        self.module = module

    def forward(self, windows: TensorDictBase) -> dict[str, torch.Tensor]:
        return dict(self.module(windows).items())


def share_gradients(loss_module: nn.Module, some: bool = False) -> nn.Module:
    """Return a loss module whose gradients are means over all processes.

    Args:
        loss_module: loss of the process's own windows.
        some: whether some parameters have no influence on the loss.
    """
    if ranks() == 1:
        return loss_module
    return nn.parallel.DistributedDataParallel(
        _Losses(loss_module), broadcast_buffers=False, find_unused_parameters=some
    )


def _restore(generator: torch.Generator, state: torch.Tensor, update: int) -> None:
    """Restore a generator, or seed it anew where the state is of another kind of device."""
    if generator.get_state().shape == state.shape:
        generator.set_state(state)
    else:
        generator.manual_seed(generator.initial_seed() + 1_000_000 * update)


def make_optimizer(module: nn.Module, learning_rate: float, weight_decay: float) -> torch.optim.Optimizer:
    """Make the AdamW optimiser of all trainings by imitation or prediction."""
    return torch.optim.AdamW(
        module.parameters(), learning_rate, betas=(0.9, 0.99), weight_decay=weight_decay, fused=True
    )


def set_learning_rate(optimizer, peak: float, update: int, updates: int) -> None:
    """Set the learning rate: 100 updates of warm-up, then a cosine to 2 % of the peak."""
    factor = min(1.0, (update + 1) / 100) * (0.51 + 0.49 * math.cos(math.pi * update / updates))
    for group in optimizer.param_groups:
        group["lr"] = peak * factor


def step(loss: torch.Tensor, optimizer) -> torch.Tensor:
    """Take one optimiser step with clipped gradients and return their norm, without waiting for a GPU."""
    optimizer.zero_grad()
    loss.backward()
    norm = nn.utils.clip_grad_norm_([p for g in optimizer.param_groups for p in g["params"]], 1.0)
    optimizer.step()
    return norm


def check_loss(loss: float, norm: torch.Tensor, first: float | None = None) -> float:
    """Return the first loss of a run, which is ``loss`` where ``first`` is None.

    Raises:
        ValueError: loss or norm of the gradients is not finite, or the loss is ten times the first one.
    """
    if not (math.isfinite(loss) and norm.isfinite()):
        raise ValueError(f"the loss is not finite; {ADVICE}")
    if first is not None and loss > 10 * first:
        raise ValueError(f"the loss diverges ({loss:.3g}, at first {first:.3g}); {ADVICE}")
    return loss if first is None else first
