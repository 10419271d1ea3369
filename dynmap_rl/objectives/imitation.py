"""The policy's loss: L1 between expert and predicted action (paper, Sec. III-B)."""

from __future__ import annotations

import torch

from dynmap_rl.modules import Normalizer


def imitation_loss(
    predicted: torch.Tensor,
    action: torch.Tensor,
    normalizer: Normalizer,
    ignore: torch.Tensor | None = None,
) -> torch.Tensor:
    """Mean absolute difference of two actions ``[..., A]`` (SI units), in normalised units: a scalar.

    Args:
        ignore: bool ``[..., 1]``, steps that do not count (the demonstrator did not act in them).
    """
    error = ((predicted - action) / normalizer.scale).abs().mean(-1, keepdim=True)
    if ignore is None:
        return error.mean()
    return (error * ~ignore).sum() / (~ignore).sum()
