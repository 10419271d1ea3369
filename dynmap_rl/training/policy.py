"""Training loops that the recipes share: the world model alone, and a policy on a frozen world model's states."""

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
    truncate_metrics(folder, 0)
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
