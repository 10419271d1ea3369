"""Figures of demonstrations (paper, Fig. 2 to 4), policy losses (Fig. 7) and closed-loop episodes (Fig. 8).

Fig. 6 and 9 show a world model: see :func:`dynmap_rl.reporting.plot_prediction`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from dynmap_rl.envs.tasks import SUCCESS_DISTANCE
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.reporting.figures import COMPONENTS, UNITS, moving_steps, plt, save_figure
from dynmap_rl.utils.files import read_json

FRAMES = 8  # in a film strip


def widest_ways(episodes: TensorDictBase, count: int) -> TensorDictBase:
    """Return the ``count`` episodes in which the cart's path spans most of x and y.

    Episodes with pushes come last.

    Args:
        episodes: demonstrations ``[E, T]``.
        count: number of episodes.
    """
    position = episodes["dynamics", "position"][..., :2]
    area = (position.amax(1) - position.amin(1)).prod(-1)
    pushed = episodes["disturbed"].flatten(1).any(1)
    return episodes[(area - 1.0 * pushed).argsort(descending=True)[:count]]


def plot_trajectory(episode: TensorDictBase, constants: dict, path: Path) -> None:
    """Draw a demonstration over time (paper, Fig. 2): frames, the cart's action and the block's dynamics.

    Args:
        episode: demonstration ``[T]``.
        constants: of the dataset's normalisation; each panel's title gives the range that becomes [-1, 1].
        path: file to write.
    """
    figure = plt.figure(figsize=(10, 8.5), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[1, 5])
    upper.suptitle("Balance-Reaching: a demonstration, normalised action and dynamics", fontsize=11)
    _draw_strip(upper.subplots(1, FRAMES), episode)
    axes = lower.subplots(4, 3, sharex=True, sharey=True)
    time = np.arange(len(episode)) * CONTROL_DT
    for row, quantity in enumerate(("action", *DYNAMICS)):
        action = quantity == "action"
        values = episode["action"] if action else episode["dynamics", quantity]
        normal = Normalizer(**constants[quantity]).normalize(values)
        units = UNITS["position" if action else quantity]
        for column, component in enumerate(COMPONENTS):
            axis, index = axes[row, column], column + (0 if action else 3)
            axis.plot(time, normal[:, index], "tab:blue" if action else "tab:green", lw=1.2)
            low, high = (constants[quantity][name][index] for name in ("low", "high"))
            what = f"action $\\Delta${component}" if action else f"block {quantity} {component}"
            axis.set_title(f"{what} ({low:.2g} to {high:.2g} {units[column]})", fontsize=8)
            axis.tick_params(labelsize=7)
            axis.grid(alpha=0.3)
        axes[row, 0].set_ylabel("normalised", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    save_figure(figure, path)


def plot_film_strips(episodes: dict[str, TensorDictBase], path: Path) -> None:
    """Draw demonstrations as strips of frames (paper, Fig. 3), from the start until the block rests.

    Args:
        episodes: a demonstration ``[T]`` of each task, by title.
        path: file to write.
    """
    figure = plt.figure(figsize=(1.3 * FRAMES, 1.8 * len(episodes)), layout="constrained")
    rows = figure.subfigures(len(episodes), 1, squeeze=False).flat
    for row, (title, episode) in zip(rows, episodes.items(), strict=True):
        row.suptitle(title, fontsize=10)
        _draw_strip(row.subplots(1, FRAMES), episode)
    save_figure(figure, path)


def _draw_strip(axes, episode: TensorDictBase) -> None:
    for axis, t in zip(axes, moving_steps(episode, len(axes)), strict=True):
        axis.imshow(episode["pixels"][t].permute(1, 2, 0).numpy())
        axis.set(xticks=[], yticks=[])
        axis.set_xlabel(f"{t * CONTROL_DT:.2f} s", fontsize=8)


def plot_scenes(frames: torch.Tensor, path: Path, columns: int = 8, rows: int = 4) -> None:
    """Draw first frames in a grid (paper, Fig. 4).

    Args:
        frames: uint8 ``[N, 3, 64, 64]``; at most ``rows * columns`` are drawn.
        path: file to write.
        columns: frames in a row.
        rows: largest number of rows.
    """
    frames = frames[: rows * columns].permute(0, 2, 3, 1).numpy()
    rows = -(-len(frames) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(1.2 * columns, 1.2 * rows + 0.4), layout="constrained"
    )
    figure.suptitle(
        "Start states, 1 m x 1 m each: positions, sizes and colours differ in every episode", fontsize=11
    )
    for axis in axes.flat:
        axis.axis("off")
    for axis, frame in zip(axes.flat, frames, strict=False):
        axis.imshow(frame)
    save_figure(figure, path)


def read_losses(results: Iterable[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Read the policy losses of every seed of some results, at the optimiser steps that all of them have logged.

    Args:
        results: contents of ``eval.json``; those of a release without ``losses`` have no curves.

    Returns:
        The steps ``[S]`` and the plain L1 losses on held-out demonstrations ``[R, S]`` of all R seeds (normalised units).
    """
    curves = [
        dict(zip(seed["losses"]["step"], seed["losses"]["held_out"], strict=True))
        for result in results
        for seed in result["results"]
        if "losses" in seed
    ]
    steps = sorted(set.intersection(*map(set, curves))) if curves else []
    return np.array(steps), np.array([[curve[step] for step in steps] for curve in curves])


def loss_panels(task: str, architecture: str = "glimpse") -> dict[str, dict[str, list[str]]]:
    """Return the panels of Fig. 7: title to label to names of cells.

    A panel compares one thing. All else is decoupled training of recurrent policies over all supervisions.

    Args:
        task: task of the cells.
        architecture: form of the world models, ``glimpse`` or ``plain``, with which there is no joint training.
    """
    plain = architecture == "plain"
    supervisions = [some for n in range(len(DYNAMICS) + 1) for some in combinations(DYNAMICS, n)]

    def cells(training="plain" if plain else "decoupled", policy="recurrent", among=supervisions):
        return [f"{task}_{training}_{'_'.join(s) or 'none'}_{policy}" for s in among]

    joint = {} if plain else {"joint": cells("joint")}
    end_to_end = [f"{task}{'_plain' if plain else ''}_end_to_end_recurrent"]
    panels = {
        "(a) dynamics supervision": {row_name(s): cells(among=[s]) for s in supervisions},
        "(b) training approach": {"decoupled": cells(), **joint, "end-to-end": end_to_end},
        "(c) policy type": {"recurrent": cells(), "feedforward": cells(policy="feedforward")},
    }
    for letter, quantity in zip("def", DYNAMICS, strict=True):
        panels[f"({letter}) {quantity} prediction"] = {
            f"with {quantity}": cells(among=[s for s in supervisions if quantity in s]),
            f"without {quantity}": cells(among=[s for s in supervisions if quantity not in s]),
        }
    return panels


def find_losses(panels: dict[str, dict[str, list[str]]], folder: Path) -> dict[str, dict]:
    """Return the results of the panels' runs that have losses, by name, and print how many there are.

    Raises:
        ValueError: there is none.
    """
    names = {name for groups in panels.values() for group in groups.values() for name in group}
    results = {name: read_json(path) for name in names if (path := folder / f"{name}.json").exists()}
    results = {name: result for name, result in results.items() if "losses" in result["results"][0]}
    if not results:
        raise ValueError(
            f"{folder} must have results with losses; run python recipes/paper/tables.py --results runs/results"
        )
    print(f"{len(results)} of {len(names)} results are there")
    return results


def plot_losses(panels: dict[str, dict[str, list[str]]], results: Mapping[str, dict], path: Path) -> None:
    """Draw policy losses during training (paper, Fig. 7).

    A panel has a curve for each group of runs: the mean over the seeds of all its runs, with a band of one standard
    deviation where there are few groups.

    Args:
        panels: see :func:`loss_panels`.
        results: contents of ``eval.json`` by the names of the runs.
        path: file to write.
    """
    figure, axes = plt.subplots(3, 2, figsize=(11, 12), layout="constrained", sharey=True)
    title = "Balance-Reaching, policy loss on held-out demonstrations (plain L1): mean and std over runs and seeds"
    figure.suptitle(title, fontsize=11)
    axes[0, 0].set_yscale("log")
    for axis, (title, groups) in zip(axes.flat, panels.items(), strict=True):
        axis.set_title(title, fontsize=10)
        for number, (label, names) in enumerate(groups.items()):
            done = [results[name] for name in names if name in results]
            steps, losses = read_losses(done)
            if not len(steps):
                axis.plot([], [], f"C{number}", label=f"{label}: not run")
                continue
            part = f" ({len(done)} of {len(names)} runs)" if len(done) < len(names) else ""
            mean, deviation = losses.mean(0), losses.std(0)
            axis.plot(steps, mean, f"C{number}", lw=1.3, marker=".", ms=3, label=label + part)
            if len(groups) < 4:  # more bands hide each other
                low, high = mean - deviation, mean + deviation
                axis.fill_between(steps, low, high, color=f"C{number}", alpha=0.15, lw=0)
        axis.set_xlabel("optimiser step", fontsize=8)
        axis.set_ylabel("policy loss (normalised action)", fontsize=8)
        axis.tick_params(which="both", labelsize=7, labelleft=True)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
        axis.grid(which="both", alpha=0.3)
        axis.legend(fontsize=7, loc="upper right", ncols=1 + len(groups) // 5)
        if not any(len(line.get_xdata()) for line in axis.lines):
            _mark_as_missing(axis)
    save_figure(figure, path)


def plot_position_errors(panels: dict[str, TensorDictBase | None], path: Path) -> None:
    """Draw position errors along closed-loop episodes (paper, Fig. 8), a panel for each policy.

    Args:
        panels: title to episodes ``[E, T]`` of :func:`dynmap_rl.evaluation.roll_out`, or to None where there is no run.
        path: file to write.
    """
    figure, axes = plt.subplots(
        1, len(panels), figsize=(11, 4.2), layout="constrained", sharex=True, sharey=True
    )
    for axis, (title, episodes) in zip(axes, panels.items(), strict=True):
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("time [s]", fontsize=9)
        axis.set_ylabel("position error [mm]", fontsize=9)
        axis.tick_params(labelsize=8, labelleft=True)
        axis.grid(alpha=0.3)
        if episodes is None:
            _mark_as_missing(axis)
        else:
            draw_position_errors(axis, episodes)
    save_figure(figure, path)


def _mark_as_missing(axis) -> None:
    axis.text(0.5, 0.5, "not run", transform=axis.transAxes, ha="center", va="center", fontsize=14)


def draw_position_errors(axis, episodes: TensorDictBase) -> None:
    """Draw the cart's distance from the goal over time for every episode ``[E, T]``.

    Episodes in which the block is dropped are red, with a dot at the moment of the drop.
    """
    position, dropped = episodes["dynamics", "position"], episodes["next", "dropped"].flatten(1)
    error = 1000 * (position[..., :2] - episodes["goal"]).norm(dim=-1)  # [E, T]
    time = np.arange(error.shape[1]) * CONTROL_DT
    ends, labels = dropped[:, -1].tolist(), {False: "block stays", True: "block dropped"}
    for end in (False, True):  # the dropped ones above the others
        for i in (i for i, value in enumerate(ends) if value is end):
            label = f"{labels.pop(end)} ({ends.count(end)})" if end in labels else None
            axis.plot(time, error[i], "tab:red" if end else "tab:blue", lw=0.9, alpha=0.7, label=label)
            if end:
                t = min(
                    int(dropped[i].int().argmax()) + 1, len(time) - 1
                )  # the flag is that of the next state
                axis.plot(time[t], error[i, t], "o", color="tab:red", ms=3)
    axis.axhline(1000 * SUCCESS_DISTANCE, color="k", lw=1, ls="--", label="success: under 50 mm")
    axis.set_ylim(bottom=0)
    axis.legend(fontsize=8, loc="upper right")
