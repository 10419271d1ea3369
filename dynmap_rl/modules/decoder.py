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
    """Plain CNN from predicted latents and hidden states to frames, the counterpart of :class:`PlainEncoder`.

    Args:
        input_size: Z + 2 H.
        channels: channels of the maps of stride 8 and 4.
        outputs: numbers for each pixel.
        image_size: side S of the frames, a multiple of 8.
    """

    def __init__(
        self, input_size: int, channels: tuple[int, int] = (64, 32), outputs: int = 3, image_size: int = 64
    ):
        super().__init__()
        (c1, c2), side = channels, image_size // 8
        self.expand = nn.Linear(input_size, c1 * side**2)
        self.layers = nn.Sequential(
            nn.Unflatten(1, (c1, side, side)),
            nn.ReLU(),
            up(c1, c2),
            nn.Conv2d(c2, outputs * BLOCK**2, 3, 1, 1),
        )

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, S, S]``, about 0..1."""
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        frames = self.draw(x.reshape(-1, x.shape[-1]))
        return frames.reshape(*x.shape[:-1], *frames.shape[1:]) + 0.5

    def draw(self, x: torch.Tensor) -> torch.Tensor:
        """Map states ``[N, Z + 2 H]`` to ``[N, outputs, S, S]``."""
        return F.pixel_shuffle(self.layers(self.expand(x)), BLOCK)


class SpriteDecoder(nn.Module):
    """A canvas of a few colours, and sprites before it: small images with transparency, drawn at predicted places.

    On the canvas, a CNN mixes M predicted colours at every pixel, so that a marker or a background changes its colour by
    three numbers. The sprites are the counterpart of :class:`~dynmap_rl.modules.GlimpseEncoder`, as the writing half of
    DRAW (Gregor et al. 2015): moving an object changes two numbers and not a filter for every place, and each pixel of
    a sprite has a colour of its own from the start. Before training, sprite i is where the i-th attention map of the
    encoder looks, so that small things such as a marker get a sprite too.

    Args:
        input_size: Z + 2 H.
        sprites: number of sprites; later ones cover earlier ones.
        side: samples of a sprite along each axis.
        spacing: distance of the samples, in pixels of a frame of 64 x 64; a sprite covers the same part of larger frames.
        colors: M.
        width: width of the MLPs that paint sprites and mix colours.
        channels: channels of the CNN's maps of stride 8 and 4.
        image_size: side S of the frames, a multiple of 8.
    """

    def __init__(
        self,
        input_size: int,
        sprites: int = 6,
        side: int = 16,
        spacing: float = 1.5,
        colors: int = 4,
        width: int = 256,
        channels: tuple[int, int] = (64, 32),
        image_size: int = 64,
    ):
        super().__init__()
        self.sprites, self.side, self.spacing = sprites, side, spacing * image_size / 64
        self.image_size = image_size
        self.masks = PlainDecoder(input_size, channels, colors, image_size)
        self.colors = nn.Sequential(nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, 3 * colors))
        self.place = nn.Linear(input_size, sprites * 2)
        nn.init.eye_(self.place.weight)
        nn.init.zeros_(self.place.bias)
        self.paint = nn.Sequential(
            nn.Linear(input_size, width), nn.SiLU(), nn.Linear(width, sprites * 4 * side**2)
        )
        self.tint = nn.Linear(input_size, sprites * 3)

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, S, S]``, about 0..1."""
        x = torch.cat([predicted_latent, hidden1, hidden2], -1)
        states = x.reshape(-1, x.shape[-1])
        frames = self.draw_canvas(states).transpose(1, 2)  # rows first, as the sprites are
        color, opacity = self.draw_sprites(states).split((3, 1), 3)
        for sprite, clear in zip(color.unbind(1), (1 - opacity).unbind(1), strict=True):
            frames = torch.addcmul(sprite, frames, clear)
        frames = frames.transpose(1, 2)
        return frames.reshape(*x.shape[:-1], *frames.shape[1:])

    def draw_canvas(self, x: torch.Tensor) -> torch.Tensor:
        """Draw what is behind the sprites, ``[N, 3, S, S]``, from states ``[N, Z + 2 H]``."""
        masks = self.masks.draw(x).float().flatten(2).softmax(1)  # (N, M, S^2)
        colors = self.colors(x).float().unflatten(1, (-1, 3)) + 0.5
        return (colors.mT @ masks).unflatten(2, (self.image_size, self.image_size))

    def draw_sprites(self, x: torch.Tensor) -> torch.Tensor:
        """Draw each sprite, ``[N, sprites, S, 4, S]``, rows first: colours times opacity, and opacity."""
        count, side = len(x), self.side
        sprites = self.paint(x).float().view(count, self.sprites, side, 4, side)  # rows first
        opacity = (4 * sprites[..., 3:, :] - 2).sigmoid()
        color = sprites[..., :3, :] + self.tint(x).float().view(count, self.sprites, 1, 3, 1) + 0.5
        sprites = torch.cat([opacity * color, opacity], -2)
        place = self.place(x).float().view(count, self.sprites, 2)
        size, spacing = self.image_size, self.spacing
        across, down = (spacing * hat_kernels(place, side, spacing, size)).unbind(2)  # (N, sprites, side, S)
        rows = (down.mT @ sprites.flatten(3)).unflatten(3, (4, side))  # (N, sprites, S, 4, side)
        return (rows.flatten(2, 3) @ across).unflatten(2, (size, 4))


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
