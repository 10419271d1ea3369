"""Which states of a world model tell which dynamics, by linear maps of them, and pictures of that and of its errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from dynmap_rl.data import compute_features
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.modules import DYNAMICS, WorldModel

from .figures import plt, save_figure

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


def plot_probes(probes: dict[str, dict], path: Path) -> None:
    """R^2 of :func:`probe`, mean over the entries of a quantity: a panel a state, a row a world model by its name."""
    figure, axes = plt.subplots(
        1, len(STATES), figsize=(11, 1.5 + 0.4 * len(probes)), layout="constrained", sharey=True
    )
    figure.suptitle(
        "How much of the dynamics a linear map of a state tells (R$^2$, held-out demonstrations)", fontsize=11
    )
    for axis, state in zip(axes, STATES, strict=True):
        values = np.array([[np.mean(p[state][q]) for q in DYNAMICS] for p in probes.values()])
        axis.imshow(values, vmin=0, vmax=1, cmap="Greens", aspect="auto")
        axis.set_title(state, fontsize=10)
        axis.set_xticks(range(len(DYNAMICS)), DYNAMICS, fontsize=9)
        axis.set_yticks(range(len(probes)), probes, fontsize=9)
        for (row, column), value in np.ndenumerate(values):
            color = "w" if value > 0.6 else "k"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=8, color=color)
    save_figure(figure, path)


def plot_open_loop(errors: dict[str, dict], path: Path) -> None:
    """Errors of :func:`open_loop_errors` over the horizon: a curve a world model, dotted where all stays as last seen."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharex=True)
    figure.suptitle("Open-loop prediction: actions are given, frames are not", fontsize=11)
    for axis, key in zip(axes.T.flat, ("cart_mm", "cart_deg", "block_mm", "block_deg"), strict=True):
        body, unit = key.split("_")
        for number, (name, error) in enumerate(errors.items()):
            time = [CONTROL_DT * (step + 1) for step in range(len(error["model"][key]))]
            axis.plot(time, error["model"][key], f"C{number}", lw=1.3, label=name)
        axis.plot(time, error["still"][key], "k:", lw=1, label="all stays where it was")
        axis.set_ylabel(f"{body}, mean error [{unit}]", fontsize=9)
        axis.grid(alpha=0.3)
        axis.set_ylim(bottom=0)
    for axis in axes[1]:
        axis.set_xlabel("time since the last frame [s]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    save_figure(figure, path)
