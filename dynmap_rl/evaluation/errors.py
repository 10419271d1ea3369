"""Errors of world models and policies on held-out episodes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import nn

from dynmap_rl.data.features import compute_features
from dynmap_rl.modules.actor import STATES
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import imitation_loss


def known_dynamics(episodes: TensorDictBase, quantity: str) -> torch.Tensor:
    """Return a quantity of the dynamics ``[E, T, D]``, NaN where ``labelled`` says that it is not known."""
    values, known = episodes["dynamics", quantity], episodes.get("labelled", None)
    return values if known is None else values.where(known.reshape(*episodes.shape, -1), torch.nan)


@torch.no_grad()
def prediction_errors(
    world_model: WorldModel, episodes: TensorDictBase, batch: int = 10, by_entry: bool = False
) -> dict[str, float]:
    """Measure one-step prediction errors.

    Args:
        world_model: world model to measure.
        episodes: TensorDict ``[E, T]`` with ``pixels``, ``action`` and ``dynamics``; dynamics that ``labelled`` says are
            not known are left out.
        batch: episodes at a time.
        by_entry: give the error of every entry of the dynamics instead of the means. Without it, the entries must be x, y
            and angle of each body, or x and y of one or two points.

    Returns:
        ``error_rgb``, the root mean square error of the frames (0 to 1), and for every supervised quantity the mean
        absolute error of x and y, ``error_position`` (m, m/s, m/s^2), and of the angles, ``error_position_angle`` (rad,
        rad/s, rad/s^2); with ``by_entry`` those of the single entries, ``error_position_0`` and so on.
    """
    sums, counts = Counter(), Counter()
    device = next(world_model.parameters()).device
    for chunk in episodes.split(batch):
        chunk = chunk.to(device)
        states = world_model.predict(world_model.encode(chunk["pixels"], mixed=True), chunk["action"])
        some = [s[:, 1::10] for s in states]  # a tenth of the frames is enough
        error = world_model.decode_pixels(*some) - chunk["pixels"][:, 1::10] / 255
        rgb = error.square().flatten(2).mean(-1).sqrt()
        errors = {"rgb": (rgb, torch.ones_like(rgb, dtype=torch.bool))}
        for name, value in world_model.decode_dynamics(*states).items():
            truth = known_dynamics(chunk, name)
            difference, known = (value - truth)[:, 1:].abs(), truth[:, 1:].isfinite()
            size = difference.shape[-1]
            for group, entries in _group_entries(size, by_entry).items():
                errors[f"{name}{group}"] = difference[..., entries], known[..., entries]
        for name, (value, known) in errors.items():
            sums[f"error_{name}"] += value[known].sum().item()
            counts[f"error_{name}"] += known.sum().item()
    return {name: sums[name] / (counts[name] or torch.nan) for name in counts}


def _group_entries(size: int, by_entry: bool) -> dict[str, list[int]]:
    """Return the entries of a quantity by the ends of their metrics' names: those of a group share a unit."""
    if by_entry:
        return {f"_{i}": [i] for i in range(size)}
    if size % 3:  # points, without an angle
        return {"": list(range(size))}
    return {"": [i for i in range(size) if i % 3 < 2], "_angle": list(range(2, size, 3))}


def naive_errors(values: torch.Tensor) -> dict[str, list[float]]:
    """Return the mean absolute errors of two simple predictions of every entry.

    Args:
        values: ``[E, T, D]``, NaN where a value is not known.

    Returns:
        ``constant``: errors of the best constant, ``[D]``. ``earlier``: those of the value one step earlier.
    """
    flat = values.flatten(0, 1)
    return {
        "constant": (flat - flat.nanmedian(0).values).abs().nanmean(0).tolist(),
        "earlier": values.diff(dim=1).abs().nanmean((0, 1)).tolist(),
    }


@torch.no_grad()
def policy_errors(policy: nn.Module, features: TensorDictBase) -> dict[str, float]:
    """Measure the errors of a policy's actions.

    Args:
        policy: policy to measure.
        features: held-out states and actions (see :func:`dynmap_rl.data.compute_features`).

    Returns:
        ``imitation_l1``, the paper's loss in normalised units, and the mean absolute error of every entry of the action
        in the dataset's units, ``error_action_0`` and so on; both without disturbed steps.
    """
    features = features.to(next(policy.parameters()).device)
    predicted = policy(*(features[key] for key in (*STATES, "goal")))
    loss = imitation_loss(predicted, features["action"], policy.action, features["disturbed"])
    error = (predicted - features["action"]).abs()
    entries = error[~features["disturbed"][..., 0]].mean(0).tolist()
    return {"imitation_l1": loss.item()} | {f"error_action_{i}": e for i, e in enumerate(entries)}


def judge_held_out(
    world_model: WorldModel,
    policy: nn.Module,
    load: Callable[[], tuple[dict[str, TensorDictBase], dict]],
) -> dict[str, dict[str, float]]:
    """Measure world model and policy on the held-out episodes of a robot dataset.

    Args:
        world_model: world model to measure.
        policy: policy on the world model's states.
        load: function that returns episodes, among them ``eval``, and constants of normalisation, such as a
            ``functools.partial`` of :func:`dynmap_rl.data.load_robot_dataset` with ``only="eval"``.

    Returns:
        ``held_out``: :func:`prediction_errors` of every entry, and :func:`policy_errors`.
    """
    episodes, _ = load()
    errors = prediction_errors(world_model, episodes["eval"], by_entry=True)
    features = compute_features(world_model, episodes["eval"])
    return {"held_out": errors | policy_errors(policy, features)}
