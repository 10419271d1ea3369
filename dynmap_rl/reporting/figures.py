"""Figures of world models: reconstruction, predicted dynamics (paper, Fig. 6 and 9), probes, open-loop errors."""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from tensordict import TensorDictBase

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.envs.tasks import REST_SPEED
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.actor import STATES, make_world_model_module
from dynmap_rl.modules.world_model import WorldModel

COMPONENTS = ("x", "y", "theta")
UNITS = {
    "position": ("m", "m", "rad"),
    "velocity": ("m/s", "m/s", "rad/s"),
    "acceleration": ("m/s$^2$", "m/s$^2$", "rad/s$^2$"),
}


@torch.no_grad()
def predict(world_model: WorldModel, episodes: TensorDictBase) -> TensorDictBase:
    """Return the episodes ``[E, T]`` with the world model's one-step predictions, on the CPU."""
    episodes = episodes.select("pixels", "action", "dynamics", strict=False)
    device = next(world_model.parameters()).device
    return make_world_model_module(world_model)(episodes.clone(False).to(device)).cpu()


def plot_reconstruction(
    world_model: WorldModel,
    episodes: TensorDictBase,
    path: Path,
    steps=(1, 8, 16, 24, 60, 110),
    dt: float = CONTROL_DT,
) -> None:
    """Draw frames of episodes ``[E, T]`` and their predictions from the frame before: two rows an episode.

    Args:
        world_model: world model that predicts.
        episodes: episodes to draw.
        path: file to write.
        steps: steps to draw, of which those within the episodes are drawn.
        dt: duration of a step (s).
    """
    steps = [t for t in steps if t < episodes.shape[1]]
    figure = plt.figure(figsize=(1.3 * len(steps), 2.7 * len(episodes)))
    draw_reconstruction(figure, predict(world_model, episodes), [steps] * len(episodes), dt)
    save_figure(figure, path)


def plot_dynamics(
    world_model: WorldModel, episode: TensorDictBase, path: Path, layout: Layout = LAYOUT, units: bool = True
) -> None:
    """Draw true and predicted dynamics along one episode ``[T]``; nothing for a model without any, or with other entries.

    Args:
        world_model: world model that predicts.
        episode: one episode.
        path: file to write.
        layout: sizes and names of the task; of cart and block, the block is drawn, otherwise the first body.
        units: whether the entries are in SI units, as tracks in pixels are not.
    """
    own = {quantity: episode["dynamics", quantity].shape[-1] for quantity in world_model.supervision}
    if not own or own != world_model.sizes:
        return
    figure = plt.figure(figsize=(9, 2.2 * len(world_model.supervision)))
    draw_dynamics(figure, predict(world_model, episode[None])[0], world_model.supervision, layout, units)
    save_figure(figure, path)


def plot_prediction(world_model: WorldModel, episodes: TensorDictBase, path: Path, title: str) -> None:
    """Draw frames and dynamics in one picture (paper, Fig. 6 and 9).

    Args:
        world_model: world model that predicts.
        episodes: TensorDict ``[E, T]``; frames are taken from the steps in which the block moves, and the dynamics are
            those of the first episode.
        path: file to write.
        title: title of the picture.
    """
    rows, out = len(world_model.supervision), predict(world_model, episodes)
    heights = [2.5 * len(episodes), 2.0 * rows]
    figure = plt.figure(figsize=(10, 0.5 + sum(heights)), layout="constrained")
    figure.suptitle(title)
    upper, lower = figure.subfigures(2, 1, height_ratios=heights) if rows else (figure.subfigures(), None)
    draw_reconstruction(upper, out, [moving_steps(episode, 8, first=1) for episode in out])
    if lower:
        draw_dynamics(lower, out[0], world_model.supervision)
    save_figure(figure, path)


def plot_perception(
    world_models: dict[str, WorldModel],
    episodes: TensorDictBase,
    path: Path,
    steps=(2, 20),
    dt: float = CONTROL_DT,
) -> None:
    """Draw frames of episodes ``[E, T]`` and, below, what each world model predicted from the frame before.

    Args:
        world_models: by name.
        episodes: one column each.
        path: file to write.
        steps: time steps, from the top.
        dt: control step (s).
    """
    rows = {"frame": episodes["pixels"] / 255}
    rows |= {
        name: predict(model, episodes)["reconstruction", "pixels"] for name, model in world_models.items()
    }
    shape = len(steps) * len(rows), len(episodes)
    figure, axes = plt.subplots(
        *shape, figsize=(1.1 * shape[1] + 1.5, 1.1 * shape[0]), squeeze=False, layout="constrained"
    )
    shown = [
        (f"frame, {t * dt:.2f} s" if name == "frame" else name, frames[:, t])
        for t in steps
        for name, frames in rows.items()
    ]
    for row, (name, frames) in zip(axes, shown, strict=True):
        for axis, frame in zip(row, frames, strict=True):
            axis.imshow(frame.clamp(0, 1).permute(1, 2, 0).numpy())
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(name.replace(", ", "\n"), rotation=0, ha="right", va="center", fontsize=8)
    save_figure(figure, path)


def draw_reconstruction(figure, out: TensorDictBase, steps: list[list[int]], dt: float = CONTROL_DT) -> None:
    """Draw frames of episodes ``[E, T]`` (see :func:`predict`) and their predictions at the ``steps`` of each."""
    axes = figure.subplots(2 * len(out), len(steps[0]), squeeze=False)
    for row, episode in enumerate(out):
        truth = episode["pixels"].permute(0, 2, 3, 1).numpy()
        guess = episode["reconstruction", "pixels"].clamp(0, 1).permute(0, 2, 3, 1).float().numpy()
        for column, t in enumerate(steps[row]):
            axes[2 * row, column].imshow(truth[t])
            axes[2 * row + 1, column].imshow(guess[t])
            if row == 0 or steps[row] != steps[row - 1]:
                axes[2 * row, column].set_title(f"{t * dt:.2f} s", fontsize=9)
        axes[2 * row, 0].set_ylabel("true", fontsize=9)
        axes[2 * row + 1, 0].set_ylabel("predicted", fontsize=9)
    for axis in axes.flat:
        axis.set(xticks=[], yticks=[])


def draw_dynamics(
    figure, out: TensorDictBase, supervision: tuple[str, ...], layout: Layout = LAYOUT, units: bool = True
) -> None:
    """Draw the dynamics of a body along one episode ``[T]`` (see :func:`predict`), a row for each quantity."""
    time, first = np.arange(out.shape[0]) * layout.dt, 3 if layout == LAYOUT else 0
    count = min(3, len(layout.position) - first)  # a point has two entries
    axes = figure.subplots(len(supervision), count, squeeze=False, sharex=True)
    for row, quantity in enumerate(supervision):
        for column in range(count):
            axis, index = axes[row, column], first + column
            body, _, component = layout.dynamics[quantity][index].rpartition("_")
            unit = f" [{UNITS[quantity][2 if component == 'theta' else 0]}]" if units else ""
            axis.plot(time, out["dynamics", quantity][:, index], "k", lw=1, label="true")
            predicted = out["predicted_dynamics", quantity][1:, index]
            axis.plot(time[1:], predicted, "tab:green", lw=1, label="predicted")
            axis.set_title(f"{body} {quantity} {component}{unit}", fontsize=8)
            axis.tick_params(labelsize=7)
    for axis in axes[-1]:
        axis.set_xlabel("time [s]", fontsize=8)
    axes[0, 0].legend(fontsize=7)


def moving_steps(episode: TensorDictBase, count: int, first: int = 0) -> list[int]:
    """Return ``count`` steps of an episode ``[T]``, evenly spaced from ``first`` to the block's last movement."""
    speed = episode["dynamics", "velocity"][:, 3:5].norm(dim=-1)
    moving = (speed > REST_SPEED).nonzero().flatten().tolist()
    last = min(max([first + count - 1, *moving[-1:]]), len(speed) - 1)
    return np.linspace(first, last, count).round().astype(int).tolist()


def plot_distributions(dynamics: dict[str, TensorDictBase], path: Path) -> dict[str, dict[str, list[float]]]:
    """Draw histograms of the angles and angular velocities of cart and block, and of the block's tilt on the cart.

    Every task has a row.

    Args:
        dynamics: ``position`` and ``velocity`` ``[E, T, 6]`` by name of the task.
        path: file to write.

    Returns:
        For each task and each histogram the 0.1, 50 and 99.9 % quantiles of the magnitude (rad, rad/s).
    """
    panels = {
        f"{body} {name}": (lambda d, quantity=quantity, index=index: d[quantity][..., index], unit)
        for name, quantity, unit in (("angle", "position", "rad"), ("angular velocity", "velocity", "rad/s"))
        for body, index in (("cart", 2), ("block", 5))
    }
    panels["tilt of the block on the cart"] = (lambda d: d["position"][..., 5] - d["position"][..., 2], "rad")
    figure, axes = plt.subplots(len(dynamics), len(panels), figsize=(15, 2 * len(dynamics)), squeeze=False)
    ranges: dict[str, dict[str, list[float]]] = {task: {} for task in dynamics}
    for column, (title, (measure, unit)) in enumerate(panels.items()):
        values = {task: measure(d).flatten().double().numpy() for task, d in dynamics.items()}
        for row, (task, value) in enumerate(values.items()):
            axis, limit = axes[row, column], np.abs(value).max() or 1
            axis.hist(value, bins=np.linspace(-limit, limit, 81), log=True, color="tab:green")
            axis.set_title(f"{title} [{unit}]" if row == 0 else "", fontsize=9)
            axis.set_ylabel(f"{task}\nsteps" if column == 0 else "", fontsize=8)
            axis.tick_params(labelsize=7)
            ranges[task][title] = np.quantile(np.abs(value), (0.001, 0.5, 0.999)).round(4).tolist()
    save_figure(figure, path)
    return ranges


def save_figure(figure, path: Path) -> None:
    """Write a figure and close it; a figure without a layout engine is laid out tightly."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plot_probes(probes: dict[str, dict], path: Path) -> None:
    """Draw R^2, averaged over the entries of a quantity: a panel for each state, a row for each world model.

    Args:
        probes: results of :func:`dynmap_rl.evaluation.probe` by name of the world model.
        path: file to write.
    """
    figure, axes = plt.subplots(
        1, len(STATES), figsize=(11, 1.5 + 0.4 * len(probes)), layout="constrained", sharey=True
    )
    figure.suptitle(
        "R$^2$ of linear maps from the states to the dynamics (held-out demonstrations)", fontsize=11
    )
    for axis, state in zip(axes, STATES, strict=True):
        values = np.array([[np.nanmean(p[state][q]) for q in DYNAMICS] for p in probes.values()])
        axis.imshow(values, vmin=0, vmax=1, cmap="Greens", aspect="auto")
        axis.set_title(state, fontsize=10)
        axis.set_xticks(range(len(DYNAMICS)), DYNAMICS, fontsize=9)
        axis.set_yticks(range(len(probes)), probes, fontsize=9)
        for (row, column), value in np.ndenumerate(values):
            color = "w" if value > 0.6 else "k"
            axis.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=8, color=color)
    save_figure(figure, path)


def plot_open_loop(errors: dict[str, dict], path: Path) -> None:
    """Draw errors over the horizon: a curve for each world model, and a dotted one for the constant last pose.

    Args:
        errors: results of :func:`dynmap_rl.evaluation.open_loop_errors` by name of the world model.
        path: file to write.
    """
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained", sharex=True)
    figure.suptitle("Open-loop prediction from actions without frames", fontsize=11)
    for axis, key in zip(axes.T.flat, ("cart_mm", "cart_deg", "block_mm", "block_deg"), strict=True):
        body, unit = key.split("_")
        for number, (name, error) in enumerate(errors.items()):
            time = [CONTROL_DT * (step + 1) for step in range(len(error["model"][key]))]
            axis.plot(time, error["model"][key], f"C{number}", lw=1.3, label=name)
        axis.plot(time, error["still"][key], "k:", lw=1, label="constant last pose")
        axis.set_ylabel(f"{body}, mean error [{unit}]", fontsize=9)
        axis.grid(alpha=0.3)
        axis.set_ylim(bottom=0)
    for axis in axes[1]:
        axis.set_xlabel("time since the last frame [s]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    save_figure(figure, path)
