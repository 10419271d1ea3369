"""Which states of a world model tell which dynamics, by linear maps of them, and pictures of that and of its errors."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from dynmap_rl.data.features import compute_features
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.world_model import WorldModel

STATES = "latent", "hidden1", "hidden2"


@torch.no_grad()
def probe(world_model: WorldModel, train: TensorDictBase, test: TensorDictBase) -> dict[str, dict]:
    """How much of the dynamics a linear map of a state tells, where the map is fitted to demonstrations and judged on
    others.

    Args:
        world_model: frozen. Its latent at t sees the frame at t, its hidden states at t everything before.
        train, test: episodes ``[E, T]`` with ``pixels``, ``action``, ``goal`` and ``dynamics``.

    Returns:
        For each of ``latent``, ``hidden1``, ``hidden2`` and each quantity R^2 on ``test`` for cart x, y, theta, block x,
        y, theta, a list: 1 is all of it, 0 what the mean tells. Steps t = 0, where memory is empty, are left out.
    """
    inputs = [_states(world_model, episodes) for episodes in (train, test)]
    targets = [
        torch.cat([episodes["dynamics", quantity][:, 1:] for quantity in DYNAMICS], -1).flatten(0, 1).double()
        for episodes in (train, test)
    ]
    result = {}
    for state in STATES:
        r2 = _explained(*(part[state] for part in inputs), *targets).tolist()
        result[state] = {quantity: r2[6 * i : 6 * i + 6] for i, quantity in enumerate(DYNAMICS)}
    return result


def _states(world_model: WorldModel, episodes: TensorDictBase) -> dict[str, torch.Tensor]:
    features = compute_features(world_model, episodes)
    return {state: features[state][:, 1:].flatten(0, 1).double().cpu() for state in STATES}


def _explained(x: torch.Tensor, x_test: torch.Tensor, y: torch.Tensor, y_test: torch.Tensor) -> torch.Tensor:
    """R^2 ``[D]`` of a linear map of ``x`` ``[N, F]`` fitted to ``y`` ``[N, D]`` by least squares."""
    mean, center = x.mean(0), y.mean(0)
    # This driver also takes states that are constant.
    weights = torch.linalg.lstsq(x - mean, y - center, driver="gelsd").solution
    rest = y_test - center - (x_test - mean) @ weights
    return 1 - rest.square().sum(0) / (y_test - y_test.mean(0)).square().sum(0)
