"""The policy's loss: L1 between expert and predicted action (paper, Sec. III-B)."""

from __future__ import annotations

import torch

from dynmap_rl.modules import Normalizer


def imitation_loss(predicted: torch.Tensor, action: torch.Tensor, normalizer: Normalizer) -> torch.Tensor:
    """Mean absolute difference of two actions ``[..., A]`` (SI units), in normalised units: a scalar."""
    return ((predicted - action) / normalizer.scale).abs().mean()
