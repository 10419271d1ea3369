"""Linear probes: how much of the dynamics a linear map reads from each state of a world model."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from dynmap_rl.data.features import compute_features
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.actor import STATES
from dynmap_rl.modules.world_model import WorldModel

from .errors import known_dynamics

GOOD = 0.75  # R^2 of the velocities; chosen between the sources of task 1 that lead to success and those that do not


@torch.no_grad()
def probe(world_model: WorldModel, train: TensorDictBase, test: TensorDictBase) -> dict[str, dict]:
    """Fit linear maps from every state to the dynamics, and measure R^2 on other episodes.

    The latent at t is a function of the frame at t, the hidden states at t of everything before.

    Args:
        world_model: world model with frozen weights.
        train: episodes ``[E, T]`` with ``pixels``, ``action``, ``goal`` and ``dynamics``, to fit the maps to.
        test: likewise, to measure R^2 on.

    Returns:
        For each of ``latent``, ``hidden1``, ``hidden2`` and each quantity a list of R^2, one for each entry (cart x, y,
        theta, block x, y, theta): 1 is a perfect map, 0 as good as the mean. Steps t = 0, at which memory is empty, are
        left out, and so are values that ``labelled`` says are not known. R^2 of an entry that rests in the test episodes,
        or is not known in any, is NaN.
    """
    inputs = [_states(world_model, episodes) for episodes in (train, test)]
    targets = [
        torch.cat([known_dynamics(episodes, name)[:, 1:] for name in DYNAMICS], -1)
        .flatten(0, 1)
        .double()
        .cpu()
        for episodes in (train, test)
    ]
    sizes, result = [test["dynamics", quantity].shape[-1] for quantity in DYNAMICS], {}
    for state in STATES:
        parts = _explained(*(part[state] for part in inputs), *targets).split(sizes)
        result[state] = {quantity: part.tolist() for quantity, part in zip(DYNAMICS, parts, strict=True)}
    return result


def judge_states(probed: dict[str, dict]) -> dict:
    """Judge a world model by the velocities that a linear map reads from its best state, without a policy.

    On task 1, with the plain CNN, R^2 ranks sources of dynamics much like the success of recurrent policies
    (``recipes/results/sources_plain``), on which the limit was chosen. On task 2 it separates sources that lead to much
    success from those that lead to little.

    Args:
        probed: result of :func:`probe`.

    Returns:
        ``verdict`` (``good`` from an R^2 of 0.75 on, or ``doubtful``), the best ``state``, and its mean ``r2`` over the
        entries that move; ``r2`` is None if none does.
    """
    means = {
        state: torch.tensor(found["velocity"]).nanmean().nan_to_num(-torch.inf).item()
        for state, found in probed.items()
    }
    state = max(means, key=means.get)
    r2 = means[state] if means[state] > -torch.inf else None  # JSON has no infinity
    return {"verdict": "good" if means[state] >= GOOD else "doubtful", "state": state, "r2": r2}


def judged_text(judged: dict) -> str:
    """Return the result of :func:`judge_states` as text."""
    verdict, state, r2 = (judged[key] for key in ("verdict", "state", "r2"))
    if r2 is None:
        return f"{verdict}; nothing moves in the held-out episodes"
    return f"{verdict}; a linear map of {state} explains {r2:.2f} of the velocities"


def _states(world_model: WorldModel, episodes: TensorDictBase) -> dict[str, torch.Tensor]:
    features = compute_features(world_model, episodes)
    return {state: features[state][:, 1:].flatten(0, 1).double().cpu() for state in STATES}


def _explained(x: torch.Tensor, x_test: torch.Tensor, y: torch.Tensor, y_test: torch.Tensor) -> torch.Tensor:
    """Fit linear maps from ``x`` ``[N, F]`` to ``y`` ``[N, D]``, NaN where not known; return R^2 ``[D]`` on the test data."""
    masks, which = y.isfinite().unique(dim=1, return_inverse=True)
    result = y.new_full(which.shape, torch.nan)
    for i, known in enumerate(masks.T):  # entries that are known in the same steps have one fit
        if known.any():
            result[which == i] = _explain(x[known], x_test, y[known][:, which == i], y_test[:, which == i])
    return result


def _explain(x: torch.Tensor, x_test: torch.Tensor, y: torch.Tensor, y_test: torch.Tensor) -> torch.Tensor:
    mean, center = x.mean(0), y.mean(0)
    # This driver accepts constant states too.
    weights = torch.linalg.lstsq(x - mean, y - center, driver="gelsd").solution
    rest = y_test - center - (x_test - mean) @ weights
    total, known = (y_test - y_test.nanmean(0)).square().nansum(0), y_test.isfinite()
    # An entry that rests in the test data may still vary by the rounding of its derivative.
    moves = total > 1e-8 * known.sum(0) * y.square().mean(0)
    return 1 - rest.where(known, 0).square().sum(0) / total.where(moves, torch.nan)
