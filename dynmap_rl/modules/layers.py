"""Convolution blocks that train fast on a CPU: channels last, normalised over the channels."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F


class ChannelNorm(nn.Module):
    """LayerNorm over the channels of every pixel, ``[N, C, H, W]``.

    In channels-last memory it reads contiguous numbers: three times faster on a CPU than GroupNorm.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = x.permute(0, 2, 3, 1)
        # Autocast would widen x to float32. The kernel sums in float32 in any case.
        with torch.autocast(x.device.type, enabled=False):
            weight, bias = self.norm.weight.to(x.dtype), self.norm.bias.to(x.dtype)
            return F.layer_norm(x, x.shape[-1:], weight, bias).permute(0, 3, 1, 2)


def down(inputs: int, outputs: int) -> nn.Sequential:
    """Half the resolution."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 4, 2, 1), ChannelNorm(outputs), nn.ReLU())


def same(channels: int) -> nn.Sequential:
    """The same resolution."""
    return nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1), ChannelNorm(channels), nn.ReLU())


def up(inputs: int, outputs: int) -> nn.Sequential:
    """Twice the resolution. Without a norm, which would hide the colours' amplitude: with it the RGB loss stalls."""
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, 4, 2, 1), nn.ReLU())
