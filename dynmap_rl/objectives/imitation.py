"""The policy's loss: L1 between expert and predicted action (paper, Sec. III-B)."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from dynmap_rl.modules import Normalizer


def imitation_loss(
    predicted: torch.Tensor,
    action: torch.Tensor,
    normalizer: Normalizer,
    ignore: torch.Tensor | None = None,
    emphasis: float = 0.0,
) -> torch.Tensor:
    """Mean absolute difference of two actions ``[B, T, A]`` (SI units), in normalised units: a scalar.

    Args:
        ignore: bool ``[B, T, 1]``, steps that do not count (the demonstrator did not act in them).
        emphasis: steps count ``1 + emphasis * |a_t - a_{t-1}|`` times (normalised, ``a_{-1} = 0``). The world model's
            memory holds the last action, and copying it is nearly right in most steps; this gives weight to those in
            which the expert decides (keyframe-focused imitation, Wen et al. 2021). 0 is the paper's loss.
    """
    error = ((predicted - action) / normalizer.scale).abs().mean(-1, keepdim=True)
    weight = torch.ones_like(error)
    if emphasis:
        before = F.pad(action[:, :-1], (0, 0, 1, 0))
        weight = weight + emphasis * ((action - before) / normalizer.scale).abs().mean(-1, keepdim=True)
    if ignore is not None:
        weight = weight * ~ignore
    return (error * weight).sum() / weight.sum()
