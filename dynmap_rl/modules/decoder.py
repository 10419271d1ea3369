"""Predicted latents and hidden states to frames and dynamics (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional as F

from dynmap_rl.keys import DYNAMICS

from .layers import BLOCK, hat_kernels, up
from .normalization import Normalizer


class PlainDecoder(nn.Module):
    """Plain CNN from predicted latents and hidden states to frames (the paper's form).

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
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        blocks = self.layers(self.expand(x).flatten(0, -2))
        return F.pixel_shuffle(blocks, BLOCK).unflatten(0, x.shape[:-1]) + 0.5


class SpriteDecoder(PlainDecoder):
    """Plain CNN with sprites before it: small images with transparency, drawn at predicted places.

    The counterpart of :class:`~dynmap_rl.modules.GlimpseEncoder`, as the writing half of DRAW (Gregor et al. 2015).
    Moving an object changes two numbers and not a filter for every place, and each pixel of a sprite has a colour of
    its own from the start. What is not in a sprite is left to the CNN.

    Args:
        input_size: Z + 2 H.
        sprites: number of sprites; later ones cover earlier ones.
        side: side of a sprite, in pixels.
        width: width of the MLP that paints the sprites.
        channels: channels of the CNN's maps of stride 8 and 4.
    """

    def __init__(
        self,
        input_size: int,
        sprites: int = 2,
        side: int = 24,
        width: int = 256,
        channels: tuple[int, int] = (64, 32),
    ):
        super().__init__(input_size, channels)
        self.sprites, self.side = sprites, side
        self.place = nn.Linear(input_size, sprites * 2)
        nn.init.normal_(self.place.weight, std=0.05)
        nn.init.uniform_(self.place.bias, -0.3, 0.3)
        self.paint = nn.Sequential(
            nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, sprites * 4 * side**2)
        )
        self.tint = nn.Linear(input_size, sprites * 3)

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, 64, 64]``, about 0..1."""
        frames = super().forward(predicted_latent, hidden1, hidden2).float().flatten(0, -4)
        frames = frames.transpose(1, 2)  # (N, 64, 3, 64): rows first
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        shape, x = x.shape[:-1], x.flatten(0, -2)
        count, side = len(x), self.side
        sprites = self.paint(x).float().view(count, self.sprites, side, 4, side)
        opacity = (4 * sprites[..., 3:, :] - 2).sigmoid()
        color = sprites[..., :3, :] + self.tint(x).float().view(count, self.sprites, 1, 3, 1) + 0.5
        sprites = torch.cat([opacity * color, opacity], -2)  # (N, S, side, 4, side)
        place = self.place(x).float().view(count, self.sprites, 2)
        across, down = hat_kernels(place, side).unbind(2)  # (N, S, side, 64)
        rows = down.mT @ sprites.flatten(3)  # (N, S, 64, 4 * side)
        drawn = rows.unflatten(3, (4, side)).flatten(2, 3) @ across  # (N, S, 64 * 4, 64)
        for sprite in drawn.unflatten(2, (64, 4)).unbind(1):
            frames = frames * (1 - sprite[:, :, 3:]) + sprite[:, :, :3]
        return frames.transpose(1, 2).reshape(*shape, 3, 64, 64)


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
