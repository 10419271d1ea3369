"""Training loops that the recipes share: the world model alone, and a policy on a frozen world model's states."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import nn

from dynmap_rl.data.features import compute_features
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import ImitationLoss, imitation_loss

GROUPS = {"": [0, 1, 3, 4], "_angle": [2, 5]}  # entries of our tasks' dynamics that have one unit


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


STATES = ("latent", "hidden1", "hidden2", "goal")


@torch.no_grad()
def policy_errors(policy, features: TensorDictBase) -> dict[str, float]:
    """A policy on held-out states (see :func:`dynmap_rl.data.compute_features`): ``imitation_l1``, the paper's loss in
    normalised units, and the mean absolute error of every entry of the action, ``error_action_0`` and so on, in the
    dataset's."""
    features = features.to(next(policy.parameters()).device)
    predicted = policy(*(features[key] for key in STATES))
    loss = imitation_loss(predicted, features["action"], policy.action, features["disturbed"])
    entries = (predicted - features["action"]).abs().mean((0, 1)).tolist()
    return {"imitation_l1": loss.item()} | {f"error_action_{i}": e for i, e in enumerate(entries)}
