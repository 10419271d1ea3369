"""Constants between SI units and the networks' [-1, 1], saved with the weights."""

from __future__ import annotations

import torch
from torch import nn


class Normalizer(nn.Module):
    """Linear map of ``[low, high]`` to ``[-1, 1]``, without clipping.

    Args:
        low: ``[D]`` in SI units.
        high: ``[D]``, above ``low``.

    Raises:
        ValueError: an entry of ``low`` is not below ``high``.
    """

    def __init__(self, low: torch.Tensor, high: torch.Tensor):
        super().__init__()
        low, high = torch.as_tensor(low, dtype=torch.float32), torch.as_tensor(high, dtype=torch.float32)
        if low.shape != high.shape or not (low.is_meta or bool((low < high).all())):
            raise ValueError(f"low must be below high, got {low.tolist()} and {high.tolist()}")
        self.register_buffer("center", (low + high) / 2)
        self.register_buffer("scale", (high - low) / 2)

    @property
    def size(self) -> int:
        """Number of entries D."""
        return self.center.numel()

    def normalize(self, x: torch.Tensor) -> torch.Tensor:
        """Map ``[..., D]`` from SI units to [-1, 1], in the type of the weights.

        Raises:
            ValueError: the last axis has another size than D.
        """
        if x.shape[-1:] != self.center.shape:
            raise ValueError(f"expected [..., {self.size}], got {list(x.shape)}")
        return (x.to(self.center.dtype) - self.center) / self.scale

    def denormalize(self, x: torch.Tensor) -> torch.Tensor:
        """Map ``[..., D]`` from [-1, 1] to SI units."""
        return x * self.scale + self.center
