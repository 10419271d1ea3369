"""Convolution blocks that train fast on a CPU: channels last, normalised over the channels."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

BLOCK = 4  # side of the blocks of pixels that encoder and decoder work on


def to_blocks(pixels: torch.Tensor) -> torch.Tensor:
    """Rearrange frames ``[N, 3, S, S]`` to blocks of 4 x 4 pixels, ``[N, 48, S / 4, S / 4]`` in channels-last memory.

    A convolution on blocks equals one with four times the kernel and stride on pixels, and 48 channels fill a
    processor's vector units where 3 do not.
    """
    if pixels.dtype != torch.uint8 or torch.compiler.is_compiling():  # Inductor does not compile what follows
        return F.pixel_unshuffle(pixels, BLOCK).contiguous(memory_format=torch.channels_last)
    # Moving four adjacent bytes as one number is four times as fast.
    pixels = (
        pixels.clone() if pixels.storage_offset() % BLOCK else pixels
    )  # numbers begin at multiples of their size
    rows = pixels.contiguous().view(torch.int32)  # (N, 3, S, S / 4)
    blocks = rows.unflatten(2, (-1, BLOCK)).permute(0, 2, 4, 1, 3).contiguous()  # (N, S / 4, S / 4, 3, 4)
    return blocks.view(torch.uint8).flatten(3).permute(0, 3, 1, 2)


def make_grid(size: int) -> torch.Tensor:
    """Return x and y of the middles of ``size`` x ``size`` places in -1..1, ``[size, size, 2]``."""
    line = (torch.arange(size) + 0.5) * 2 / size - 1
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y], -1)


def hat_kernels(centers: torch.Tensor, count: int, spacing: float = 1.0, size: int = 64) -> torch.Tensor:
    """Return kernels that read or write ``count`` samples, ``spacing`` pixels apart, along an axis of ``size`` pixels.

    A kernel is a triangle over the pixels around its sample, so that reading and writing are linear interpolation and
    have a gradient with respect to the centre. Samples outside the frame have less weight, or none.

    Args:
        centers: middles of the samples, ``[...]``, in -1..1 from edge to edge.
        count: number of samples.
        spacing: distance of the samples in pixels.
        size: pixels of the axis.

    Returns:
        ``[..., count, size]``; the sum over the pixels is 1 inside the frame for whole spacings, and varies about 1 with
        the place of the sample for others.
    """
    steps = (torch.arange(count, device=centers.device) - (count - 1) / 2) * spacing
    pixels = torch.arange(size, device=centers.device) + 0.5
    samples = (centers[..., None] + 1) * (size / 2) + steps
    return (1 - (pixels - samples[..., None]).abs() / spacing).clamp_min(0) / spacing


def color_weights(pixels: torch.Tensor, power: float) -> torch.Tensor:
    """Return weights of pixels that fall with the frequency of their colour in the frame; their mean is 1.

    Colours count as equal if the upper four bits of their channels are.

    Args:
        pixels: frames ``[..., 3, H, W]`` in 0..255.
        power: a weight is the number of pixels of the colour to the power of ``-power``. With 1, every colour of a
            frame has the same share.

    Returns:
        ``[..., H, W]``.
    """
    red, green, blue = (pixels.byte() >> 4).short().flatten(0, -4).flatten(2).unbind(1)  # (N, H W)
    color = (256 * red + 16 * green + blue).long()  # in ONNX, shifts of int16 are wrong
    count = torch.zeros(color.shape[0], 4096, device=color.device)
    count.scatter_add_(1, color, torch.ones_like(color, dtype=count.dtype))
    weight = (-power * count.gather(1, color).log()).exp()  # three times as fast as pow
    return (weight / weight.mean(1, keepdim=True)).view(*pixels.shape[:-3], *pixels.shape[-2:])


class ChannelNorm(nn.Module):
    """LayerNorm over the channels of every pixel, ``[N, C, H, W]``.

    In channels-last memory it reads contiguous numbers and is three times as fast as GroupNorm on a CPU.

    Args:
        channels: C.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.norm = nn.LayerNorm(channels)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise ``[N, C, H, W]``."""
        x = x.permute(0, 2, 3, 1)
        # Autocast would widen x to float32, in which the kernel sums in any case.
        with torch.autocast(x.device.type, enabled=False):
            weight, bias = self.norm.weight.to(x.dtype), self.norm.bias.to(x.dtype)
            return F.layer_norm(x, x.shape[-1:], weight, bias).permute(0, 3, 1, 2)


def down(inputs: int, outputs: int) -> nn.Sequential:
    """Make a block that halves the resolution."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, 2, 1), ChannelNorm(outputs), nn.ReLU())


def same(channels: int) -> nn.Sequential:
    """Make a block that keeps the resolution."""
    return nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1), ChannelNorm(channels), nn.ReLU())


def up(inputs: int, outputs: int) -> nn.Sequential:
    """Make a block that doubles the resolution, without normalisation, with which the RGB loss stalls."""
    return nn.Sequential(nn.ConvTranspose2d(inputs, outputs, 4, 2, 1), nn.ReLU())
