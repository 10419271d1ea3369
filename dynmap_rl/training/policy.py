"""Training of a policy on the states of a frozen world model (paper, Sec. III-B)."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn
from tqdm import tqdm

from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.objectives.imitation import ImitationLoss
from dynmap_rl.runs.folder import truncate_metrics
from dynmap_rl.runs.loggers import log_metrics

from .loop import check_loss, make_optimizer, set_learning_rate, step
from .settings import PolicyTraining


def train_policy(
    policy: nn.Module,
    features: TensorDictBase,
    held_out: TensorDictBase,
    folder: Path,
    settings: PolicyTraining | None = None,
    *,
    seed: int = 0,
    done: int = 0,
    logger: str | None = None,
) -> None:
    """Minimise the L1 imitation loss on precomputed states; the world model is not needed.

    Args:
        policy: changed in place.
        features: training states ``[E, T]`` of :func:`dynmap_rl.data.compute_features`.
        held_out: held-out states, on which the plain L1 is logged.
        folder: gets ``metrics.jsonl``, whose lines after ``done`` are removed: a folder of its own.
        settings: sizes and learning rate; default :class:`PolicyTraining`.
        seed: seed of the batches, and line of the progress bar (modulo 8).
        done: updates of an earlier training of this policy, after which the metrics go on.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.

    Raises:
        ValueError: the loss is not finite or diverges.
    """
    settings, folder = settings or PolicyTraining(), Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    truncate_metrics(folder, done)
    optimizer = make_optimizer(policy, settings.learning_rate, weight_decay=1e-3)
    device = next(policy.parameters()).device
    features, held_out = features.to(device), held_out.to(device)
    generator = torch.Generator(device).manual_seed(seed)
    loss_module, plain = ImitationLoss(policy, settings.emphasis), ImitationLoss(policy)
    progress, first = tqdm(range(settings.updates), f"policy {seed}", position=seed % 8), None
    for update in progress:
        set_learning_rate(optimizer, settings.learning_rate, update, settings.updates)
        index = torch.randint(len(features), (settings.batch,), generator=generator, device=device)
        batch = features[index]
        with mixed_precision(device):
            loss = loss_module(batch)["loss_policy"]
        norm = step(loss, optimizer)
        count = update + 1
        if count % 100 == 0 or count in (1, settings.updates):
            # The first loss of a policy that goes on is no measure: it is low, and more states may raise it.
            first = check_loss(loss.item(), norm, None if done else first)
        if count % 100 == 0 or count == settings.updates:
            with torch.no_grad():
                validation = plain(held_out)["loss_policy"]
            log_metrics(folder, done + count, logger, loss=loss.item(), held_out_loss=validation)
            progress.set_postfix(loss=f"{loss:.4f}", held_out=f"{validation:.4f}")
