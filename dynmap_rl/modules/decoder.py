"""Predicted latents and hidden states to frames and dynamics (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional as F

from dynmap_rl.keys import DYNAMICS

from .layers import BLOCK, up
from .normalization import Normalizer


class ImageDecoder(nn.Module):
    """Plain CNN from predicted latents and hidden states to frames.

    Args:
        input_size: Z + 2 H.
        channels: channels of the maps of stride 8 and 4.
    """

    def __init__(self, input_size: int, channels: tuple[int, int] = (64, 32)):
        super().__init__()
        c1, c2 = channels
        self.expand = nn.Linear(input_size, c1 * 64)
        self.layers = nn.Sequential(
            nn.Unflatten(1, (c1, 8, 8)),
            nn.ReLU(),
            up(c1, c2),
            nn.Conv2d(c2, 3 * BLOCK**2, 3, 1, 1),
        )

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, 64, 64]`` in 0..1."""
        return F.pixel_shuffle(self.decode_blocks(predicted_latent, hidden1, hidden2), BLOCK) + 0.5

    def decode_blocks(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode the frame minus 0.5, as blocks ``[..., 48, 16, 16]`` (:func:`dynmap_rl.modules.layers.to_blocks`)."""
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        return self.layers(self.expand(x).flatten(0, -2)).unflatten(0, x.shape[:-1])


class DynamicsDecoder(nn.Module):
    """Shared two-layer MLP with one head for each quantity, from predicted latents and hidden states to dynamics.

    Args:
        input_size: Z + 2 H.
        normalizers: one for each decoded quantity: any of position, velocity, acceleration, or none.
        width: width of the MLP.

    Raises:
        ValueError: a quantity is unknown.
    """

    def __init__(self, input_size: int, normalizers: Mapping[str, Normalizer], width: int = 256):
        super().__init__()
        unknown = set(normalizers) - set(DYNAMICS)
        if unknown:
            raise ValueError(f"dynamics must be any of {', '.join(DYNAMICS)}, got {sorted(unknown)}")
        self.quantities = tuple(q for q in DYNAMICS if q in normalizers)
        self.normalizers = nn.ModuleDict({q: normalizers[q] for q in self.quantities})
        if self.quantities:
            self.shared = nn.Sequential(
                nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
            )
        self.heads = nn.ModuleDict({q: nn.Linear(width, normalizers[q].size) for q in self.quantities})

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to ``[..., D]`` (SI units) for each of ``quantities``, in order."""
        if not self.quantities:
            return ()
        x = self.shared(torch.cat([predicted_latent, hidden1, hidden2], -1))
        return tuple(self.normalizers[q].denormalize(self.heads[q](x).float()) for q in self.quantities)
