"""Frames to latents: ``z_t = ENC(I_t)`` (paper, Sec. III-A)."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

from .layers import BLOCK, ChannelNorm, color_weights, down, hat_kernels, make_grid, same, to_blocks


class Encoder(nn.Module):
    """Base of the encoders: any leading axes, and chunks where no gradient is needed.

    Args:
        image_size: side S of the frames, a multiple of 8.
    """

    def __init__(self, image_size: int):
        super().__init__()
        self.image_size = image_size

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Encode frames ``[..., 3, S, S]`` in 0..255, uint8 or float, as latents ``[..., Z]``.

        Raises:
            ValueError: the frames have another shape, or are floats in 0..1 or below 0.
            TypeError: the weights are not float32.
        """
        side = self.image_size
        if (dtype := next(self.parameters()).dtype) != torch.float32:
            raise TypeError(f"weights must stay float32, got {dtype}; for less precision use torch.autocast")
        if pixels.shape[-3:] != (3, side, side):
            raise ValueError(f"pixels must be [..., 3, {side}, {side}], got {list(pixels.shape)}")
        if not pixels.numel():
            size = self.encode(pixels.new_zeros(1, 3, side, side)).shape[-1]
            return torch.zeros(*pixels.shape[:-3], size, device=pixels.device)
        # A frame in 0..1 would be read as a black one.
        if pixels.is_floating_point() and not torch.compiler.is_compiling():
            low, high = pixels.aminmax()
            if low < 0 or 0 < high <= 1:
                raise ValueError(
                    f"pixels must be in 0..255, got floats in {low:.3g}..{high:.3g}; give uint8 frames, without ToTensorImage "
                    "and normalisation"
                )
        x = pixels.reshape(-1, 3, side, side)
        # Without gradients, chunks that fit into the processor's cache are twice as fast.
        chunks = (x,) if torch.is_grad_enabled() else x.split(64)
        return torch.cat([self.encode(chunk) for chunk in chunks]).reshape(*pixels.shape[:-3], -1)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        """Encode frames ``[N, 3, S, S]`` in 0..255 as latents ``[N, Z]``."""
        raise NotImplementedError


class PlainEncoder(Encoder):
    """Plain CNN. The paper has "a simple CNN-based encoder", and gives neither layers nor sizes.

    Three convolutions on blocks of 4 x 4 pixels end in maps of stride 8. The frame's mean colour, which the normalisation
    removes, reaches the latent through a linear map of its own.

    Args:
        latent_size: Z.
        channels: channels of the maps of stride 4 and 8.
        image_size: side S of the frames.
    """

    def __init__(self, latent_size: int = 64, channels: tuple[int, int] = (32, 64), image_size: int = 64):
        super().__init__(image_size)
        c1, c2 = channels
        self.stem = nn.Conv2d(3 * BLOCK**2, c1, 3, 1, 1)
        self.top = nn.Sequential(down(c1, c2), same(c2))
        self.project = nn.Linear(c2 * (image_size // 8) ** 2, latent_size)
        self.color = nn.Linear(3, latent_size, bias=False)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        # The precision of the convolutions holds 0..255 exactly; most of the memory traffic is here.
        autocast = torch.is_autocast_enabled(x.device.type)
        dtype = torch.get_autocast_dtype(x.device.type) if autocast else self.project.weight.dtype
        x = to_blocks(x).to(dtype)  # (N, 48, S / 4, S / 4)
        pixels = x.permute(0, 2, 3, 1).flatten(1, 2)  # (N, S^2 / 16, 48); a product is the fastest mean
        count = pixels.shape[1]
        color = (x.new_full((1, count), 1 / count) @ pixels).float().view(-1, 3, BLOCK**2).mean(-1)
        # Scaling the weights replaces x / 255 - 0.5.
        weight, bias = self.stem.weight / 255, self.stem.bias - 0.5 * self.stem.weight.sum((1, 2, 3))
        x = F.conv2d(x, weight, bias, padding=1).relu()  # (N, C, S / 4, S / 4)
        y = self.top(x)  # (N, C, S / 8, S / 8)
        # Mean colours differ little.
        return self.project(y.flatten(1)) + 5 * self.color(color / 255 - 0.5)  # (N, Z)


class GlimpseEncoder(Encoder):
    """CNN encoder with K attention maps, and G glimpses: crops of the frame around the positions of the first G maps.

    Convolutions on blocks of 4 x 4 pixels, with the context of maps of stride 8 added, end in attention maps of stride 2,
    to which rare colours of the frame are brighter than frequent ones. Each map pools its expected position (spatial
    softmax, Levine et al. 2016), the frame's mean colour there, and learned features. Around the positions of the first
    G maps, the encoder reads glimpses: small images that move with the map, as in DRAW (Gregor et al. 2015). In a
    glimpse an object stands at the same place wherever it is in the frame, so that a linear map finds its parts, their
    colours and its tilt. Before training, the first 2 K entries of the latent are the positions of the maps in -1..1.

    Args:
        latent_size: Z.
        channels: channels of the maps of stride 4 and 8.
        maps: K.
        features: learned features of each map.
        glimpses: G.
        samples: samples of a glimpse along each axis.
        spacing: distance of the samples, in pixels of a frame of 64 x 64; a glimpse shows the same part of larger frames.
        width: width of the MLPs from the pooled values to the latent.
        image_size: side S of the frames.
    """

    def __init__(
        self,
        latent_size: int = 64,
        channels: tuple[int, int] = (32, 48),
        maps: int = 6,
        features: int = 8,
        glimpses: int = 2,
        samples: int = 16,
        spacing: float = 1.5,
        width: int = 256,
        image_size: int = 64,
    ):
        super().__init__(image_size)
        c1, c2 = channels
        self.maps, self.glimpses, self.samples = maps, glimpses, samples
        self.spacing = spacing * image_size / 64
        self.stem = nn.Conv2d(3 * BLOCK**2, c1, 1)
        self.mix = nn.Sequential(nn.Conv2d(c1, c1, 3, 1, 1), ChannelNorm(c1))
        self.context = nn.Sequential(down(c1, c2), same(c2), nn.Conv2d(c2, c1, 1))
        self.attend = nn.Conv2d(c1, SUB**2 * maps, 1)
        self.features = nn.Conv2d(c1, features, 1)
        pooled = maps * (2 + 3 + features) + 3
        self.read = nn.Sequential(nn.Linear(glimpses * 3 * samples**2, width), nn.SiLU())
        self.mlp = nn.Sequential(nn.Linear(pooled + width, width), nn.SiLU(), nn.Linear(width, latent_size))
        self.linear = nn.Linear(pooled + width, latent_size)
        self._start_with_positions()
        # A constant product in the place of sums over strided memory, which are several times as slow.
        self.register_buffer("places", _split_blocks(make_grid(image_size // 2).permute(2, 0, 1)[None]).mT)
        self.register_buffer("average", _averages())  # (48, 4 * 3)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        count = x.shape[0]  # len(x) would be a constant in an export
        autocast = torch.is_autocast_enabled(x.device.type)
        dtype = torch.get_autocast_dtype(x.device.type) if autocast else self.linear.weight.dtype
        blocks = to_blocks(x).to(dtype)  # (N, 48, S / 4, S / 4), 0..255
        # Scaling the weights replaces blocks / 255 - 0.5.
        weight, bias = self.stem.weight / 255, self.stem.bias - 0.5 * self.stem.weight.sum((1, 2, 3))
        h = self.mix(F.conv2d(blocks, weight, bias).relu())
        h = (h + F.interpolate(self.context(h.relu()), scale_factor=2)).relu()
        # One row of memory for each map: SUB x SUB places in a block, then the blocks.
        logits = self.attend(h).float().contiguous().view(count, self.maps, -1)  # (N, K, S^2 / 4)
        attention = (logits + _rarity(x)).softmax(-1)
        colors = blocks.permute(0, 2, 3, 1).flatten(1, 2) @ (self.average / 255) - 0.5
        colors = colors.view(count, -1, SUB**2, 3).transpose(1, 2).reshape(count, -1, 3)
        mean = colors.mean(1)
        where = attention @ torch.cat([self.places.expand(count, -1, -1), colors], -1)  # (N, K, 5)
        of_blocks = attention.view(count, self.maps, SUB**2, -1).sum(2)  # (N, K, S^2 / 16)
        features = self.features(h).permute(0, 2, 3, 1).flatten(1, 2).float()
        what = of_blocks @ features  # (N, K, features)
        glimpses = self.look(x, where[:, : self.glimpses, :2], 255 * (mean + 0.5)) / 255
        values = 2 * where.flatten(1), what.flatten(1), 3 * mean, self.read(2 * glimpses.flatten(1))
        pooled = torch.cat(values, -1)
        return self.mlp(pooled) + self.linear(pooled)

    @torch.no_grad()
    def _start_with_positions(self) -> None:
        """Let the first 2 K entries of the latent start as the positions, where the decoder's sprites start."""
        count = min(2 * self.maps, self.linear.out_features)
        for layer in (self.mlp[-1], self.linear):
            layer.weight[:count] = 0
            layer.bias[:count] = 0
        entry = torch.arange(count)
        self.linear.weight[entry, 5 * (entry // 2) + entry % 2] = 0.5  # of twice (x, y, red, green, blue)

    def look(self, x: torch.Tensor, centers: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
        """Read glimpses of frames ``[N, 3, S, S]``.

        Args:
            x: frames.
            centers: ``[N, G, 2]`` in -1..1.
            background: colours ``[N, 3]`` to subtract inside the frames; outside, a glimpse is 0.

        Returns:
            ``[N, G, samples, 3, samples]``, rows first.
        """
        size = self.image_size
        across, down = hat_kernels(centers, self.samples, self.spacing, size).unbind(2)  # (N, G, samples, S)
        autocast = torch.is_autocast_enabled(x.device.type)
        dtype = torch.get_autocast_dtype(x.device.type) if autocast else down.dtype
        lines = (
            x.transpose(1, 2).flatten(2).to(dtype)
        )  # (N, S, 3 S); moving bytes is cheaper than moving floats
        rows = down.flatten(1, 2) @ lines  # (N, G samples, 3 S)
        rows = rows.view(*centers.shape[:2], -1, size)  # (N, G, samples * 3, S)
        seen = (rows @ across.mT).unflatten(2, (-1, 3))
        # (N, G, samples, 1, samples)
        inside = down.sum(-1)[..., None, None] * across.sum(-1)[:, :, None, None]
        return seen - inside * background[:, None, None, :, None]


SUB = 2  # attention maps have SUB x SUB places in a block


def _split_blocks(maps: torch.Tensor) -> torch.Tensor:
    """Order maps ``[N, C, M, M]`` by the place in a block, then by the block, ``[N, C, M^2]``."""
    return F.pixel_unshuffle(maps, SUB).flatten(2).view(*maps.shape[:2], -1)


def _averages() -> torch.Tensor:
    """Return the product from a block's 48 numbers to the mean colours of its SUB x SUB parts, ``[48, SUB**2 * 3]``."""
    side = BLOCK // SUB
    part = torch.arange(BLOCK) // side
    here = F.one_hot(SUB * part[:, None] + part, SUB**2).flatten(0, 1) / side**2  # (16, SUB**2)
    return torch.einsum("pq,cd->cpqd", here, torch.eye(3)).reshape(3 * BLOCK**2, -1)


@torch.no_grad()
def _rarity(x: torch.Tensor) -> torch.Tensor:
    """Return the logarithm of the rarity of the colours at the places of a map, ``[N, 1, S^2 / 4]``, up to a constant."""
    weight = color_weights(x, 0.75)[:, None]
    for axis in (-2, -1):  # several times as fast as pooling
        weight = sum(weight.unfold(axis, 2, 2).unbind(-1))
    return _split_blocks(weight).log()
