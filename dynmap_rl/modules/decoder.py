"""Predicted latents and hidden states to frames and dynamics (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import nn
from torch.nn import functional as F

from dynmap_rl.keys import DYNAMICS

from .layers import BLOCK, make_grid, up
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


class BlobDecoder(nn.Module):
    """Blobs at predicted places, to masks of a few predicted colours.

    An MLP places K blobs (Gaussian bells along x and y), each with a feature vector; their sum is a map of 32 x 32.
    Two convolutions turn it into one logit for each pixel and colour. The frame is the mean of M predicted colours,
    weighted by the softmax of the logits. Places and colours are outputs of an MLP, so that moving or recolouring an
    object changes few numbers and not a filter for every place.

    Args:
        input_size: Z + 2 H.
        blobs: K.
        features: entries of a blob's feature vector.
        colors: M.
        width: width of the MLPs.
        channels: channels between the convolutions.
    """

    def __init__(
        self,
        input_size: int,
        blobs: int = 16,
        features: int = 16,
        colors: int = 6,
        width: int = 256,
        channels: int = 16,
    ):
        super().__init__()
        self.sizes = 2, 2, features
        self.blobs = nn.Sequential(
            nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, blobs * (4 + features))
        )
        self.places = nn.Linear(input_size, 2 * blobs)
        nn.init.normal_(self.places.weight, std=0.05)
        nn.init.uniform_(self.places.bias, -0.6, 0.6)
        self.background = nn.Linear(input_size, features)
        self.colors = nn.Sequential(nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, 3 * colors))
        self.masks = nn.Sequential(
            nn.Conv2d(features + 2, channels, 3, 1, 1), nn.ReLU(), nn.Conv2d(channels, 4 * colors, 1)
        )
        self.register_buffer("grid", make_grid(32).permute(2, 0, 1))  # (2, 32, 32)

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, 64, 64]``, about 0..1."""
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        shape, x = x.shape[:-1], x.flatten(0, -2)
        count = len(x)
        move, sharpness, features = (
            self.blobs(x).float().view(count, -1, sum(self.sizes)).split(self.sizes, -1)
        )
        center = move + self.places(x).float().view(count, -1, 2)  # (N, K, 2)
        line = self.grid[0, 0]
        bells = ((line - center[..., None]) * (sharpness + 1.5).exp()[..., None]).square().mul(-0.5).exp()
        across, down = bells.unbind(2)  # (N, K, 32)
        rows = torch.einsum("nkc,nky->ncyk", features, down)
        maps = rows @ across[:, None] + self.background(x).float()[..., None, None]  # (N, C, 32, 32)
        maps = torch.cat([maps, self.grid.expand(count, -1, -1, -1)], 1)
        masks = F.pixel_shuffle(self.masks(maps.contiguous(memory_format=torch.channels_last)), 2)
        colors = self.colors(x).float().view(count, -1, 3)
        frames = colors.transpose(1, 2) @ masks.float().flatten(2).softmax(1)  # (N, 3, 4096)
        return frames.view(*shape, 3, 64, 64) + 0.5


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
