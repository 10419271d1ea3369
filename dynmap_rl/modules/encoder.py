"""Frames to latents: ``z_t = ENC(I_t)`` (paper, Sec. III-A)."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from .layers import BLOCK, down, same, to_blocks


class Encoder(nn.Module):
    """Plain CNN from frames to latents.

    Three convolutions on blocks of 4 x 4 pixels end in maps of 8 x 8. The frame's mean colour, which the normalisation
    removes, reaches the latent through a linear map of its own. With ``keypoints``, a spatial softmax adds the
    expected position of every channel of the 8 x 8 and 16 x 16 maps (Levine et al. 2016), so that the position of an
    object reaches the latent to a fraction of a pixel.

    Args:
        latent_size: Z.
        channels: channels of the maps of stride 4 and 8.
        keypoints: add expected positions.
    """

    def __init__(self, latent_size: int = 64, channels: tuple[int, int] = (32, 64), keypoints: bool = False):
        super().__init__()
        c1, c2 = channels
        self.stem = nn.Conv2d(3 * BLOCK**2, c1, 3, 1, 1)
        self.top = nn.Sequential(down(c1, c2), same(c2))
        self.keypoints = nn.ModuleList()
        features = c2 * 64
        if keypoints:
            self.keypoints.extend([SpatialSoftmax(c1, 32), SpatialSoftmax(c2, 32)])
            self.squeeze = nn.Conv2d(c2, 8, 1)
            features = 8 * 64 + 2 * 2 * 32
        self.project = nn.Linear(features, latent_size)
        self.color = nn.Linear(3, latent_size, bias=False)

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Encode frames ``[..., 3, 64, 64]`` in 0..255, uint8 or float, as latents ``[..., Z]``.

        Raises:
            ValueError: the frames have another shape.
        """
        if pixels.shape[-3:] != (3, 64, 64):
            raise ValueError(f"pixels must be [..., 3, 64, 64], got {list(pixels.shape)}")
        x = pixels.reshape(-1, 3, 64, 64)
        # Without gradients, chunks that fit into the processor's cache are twice as fast.
        chunks = (x,) if torch.is_grad_enabled() else x.split(64)
        return torch.cat([self._encode(chunk) for chunk in chunks]).reshape(*pixels.shape[:-3], -1)

    def _encode(self, x: torch.Tensor) -> torch.Tensor:
        # The precision of the convolutions holds 0..255 exactly; most of the memory traffic is here.
        autocast = torch.is_autocast_enabled(x.device.type)
        dtype = torch.get_autocast_dtype(x.device.type) if autocast else self.project.weight.dtype
        x = to_blocks(x).to(dtype)  # (N, 48, 16, 16)
        pixels = x.permute(0, 2, 3, 1).flatten(1, 2)  # (N, 256, 48); a product is the fastest mean
        color = (x.new_full((1, 256), 1 / 256) @ pixels).float().view(-1, 3, BLOCK**2).mean(-1) / 255 - 0.5
        # Scaling the weights replaces x / 255 - 0.5.
        weight, bias = self.stem.weight / 255, self.stem.bias - 0.5 * self.stem.weight.sum((1, 2, 3))
        x = F.conv2d(x, weight, bias, padding=1).relu()  # (N, C, 16, 16)
        y = self.top(x)  # (N, C, 8, 8)
        if self.keypoints:
            points = [read(m) for read, m in zip(self.keypoints, (x, y), strict=True)]
            features = torch.cat([self.squeeze(y).flatten(1), *points], -1)
        else:
            features = y.flatten(1)
        return self.project(features) + 5 * self.color(color)  # (N, Z); mean colours differ little


class SpatialSoftmax(nn.Module):
    """Expected positions of learned heat maps (Levine et al. 2016).

    Args:
        channels: C of the input.
        points: number of heat maps.
    """

    def __init__(self, channels: int, points: int):
        super().__init__()
        self.logits = nn.Conv2d(channels, points, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map ``[N, C, H, W]`` to positions ``[N, 2 points]`` in [-1, 1]: x of all points, then y."""
        logits = self.logits(x).float()
        heat = F.softmax(logits.flatten(2), -1).unflatten(-1, logits.shape[2:])
        across = torch.linspace(-1, 1, heat.shape[-1], device=heat.device)
        down = torch.linspace(-1, 1, heat.shape[-2], device=heat.device)
        return torch.cat([heat.sum(-2) @ across, heat.sum(-1) @ down], -1)
