"""Open-loop errors of a world model: predictions over many steps without frames."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase

from dynmap_rl.envs.imagination import ImaginationEnv, make_start
from dynmap_rl.envs.task import BODIES, LAYOUT
from dynmap_rl.modules.world_model import WorldModel


@torch.no_grad()
def open_loop_errors(
    world_model: WorldModel, episodes: TensorDictBase, context: int = 10, horizon: int = 40, batch: int = 50
) -> dict:
    """Measure the errors of poses that are predicted from actions alone, after some frames.

    Args:
        world_model: world model that decodes the poses of cart and block (see :func:`decodes_poses`).
        episodes: held-out demonstrations ``[E, T]`` with ``pixels``, ``action`` and ``dynamics``.
        context: frames that are encoded first, at least 1.
        horizon: steps that are predicted after the last of these frames.
        batch: episodes at a time.

    Returns:
        ``model``, and ``still`` for the constant prediction of the last pose. Each has ``cart_mm``, ``block_mm`` (mean
        distance, mm) and ``cart_deg``, ``block_deg`` (mean absolute difference of angles, degrees): lists of ``horizon``
        numbers, one step ahead first. ``context`` and ``episodes`` repeat the sizes.

    Raises:
        ValueError: the world model does not decode the poses of cart and block, or the episodes are too short.
    """
    if not decodes_poses(world_model):
        raise ValueError(
            f"the world model must be supervised on position, with {len(BODIES)} entries, of cart and block"
        )
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    if context < 1 or context + horizon > episodes.shape[1]:
        steps = episodes.shape[1]
        raise ValueError(f"context + horizon must be at most {steps}, got {context} + {horizon}")
    device = next(world_model.parameters()).device
    totals = {"model": 0.0, "still": 0.0}
    for chunk in episodes.split(batch):
        chunk = chunk[:, : context + horizon].to(device)
        env = ImaginationEnv(world_model, make_start(world_model, chunk[:, :context]))
        td, predicted = env.reset(), []
        for t in range(context - 1, context + horizon - 1):
            td = env.step(td.set("action", chunk["action"][:, t]))["next"]
            predicted.append(td["predicted_dynamics", "position"])
        position = chunk["dynamics", "position"]
        truth, last = position[:, context:], position[:, context - 1 : context]
        totals["model"] += _pose_errors(torch.stack(predicted, 1) - truth)
        totals["still"] += _pose_errors(last - truth)
    result = {"context": context, "episodes": len(episodes)}
    for name, total in totals.items():
        columns = (total / len(episodes)).cpu().T.tolist()
        result[name] = dict(zip(("cart_mm", "cart_deg", "block_mm", "block_deg"), columns, strict=True))
    return result


def decodes_poses(world_model: WorldModel) -> bool:
    """Return whether a world model decodes the poses of cart and block."""
    return (world_model.sizes.get("position"), world_model.transition.action.size) == (
        len(BODIES),
        len(LAYOUT.action),
    )


def _pose_errors(difference: torch.Tensor) -> torch.Tensor:
    """Convert ``[E, K, 6]`` (m, rad) to sums over episodes ``[K, 4]`` (mm, degrees; cart, then block)."""
    parts = difference.unflatten(-1, (2, 3))  # (E, K, 2, 3)
    distance, angle = parts[..., :2].norm(dim=-1) * 1000, parts[..., 2].abs() * 180 / math.pi
    return torch.stack([distance, angle], -1).flatten(2).sum(0)
