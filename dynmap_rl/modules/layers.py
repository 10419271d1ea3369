"""Convolution blocks that train fast on a CPU: channels last, normalised over the channels."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

BLOCK = 4  # encoder and decoder see frames as blocks of 4 x 4 pixels


def to_blocks(pixels: torch.Tensor) -> torch.Tensor:
    """Frames ``[N, 3, 64, 64]`` as blocks of 4 x 4 pixels, ``[N, 48, 16, 16]`` in channels-last memory.

    A convolution over blocks does what one of four times the kernel and stride does to pixels, and a processor's
    matrix units are made for 48 channels, not for 3.
    """
    if pixels.dtype != torch.uint8:
        return F.pixel_unshuffle(pixels, BLOCK).contiguous(memory_format=torch.channels_last)
    # Four bytes in a row move as one number: four times as fast.
    rows = pixels.contiguous().view(torch.int32)  # (N, 3, 64, 16)
    blocks = rows.unflatten(2, (-1, BLOCK)).permute(0, 2, 4, 1, 3).contiguous()  # (N, 16, 16, 3, 4)
    return blocks.view(torch.uint8).flatten(3).permute(0, 3, 1, 2)


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
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, 2, 1), ChannelNorm(outputs), nn.ReLU())


def same(channels: int) -> nn.Sequential:
    """The same resolution."""
    return nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1), ChannelNorm(channels), nn.ReLU())


def up(inputs: int, outputs: int) -> nn.Sequential:
    """Twice the resolution. Without a norm, which would hide the colours' amplitude: with it the RGB loss stalls."""
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, 4, 2, 1), nn.ReLU())
