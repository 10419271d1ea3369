"""Windows of episodes, and augmentations that keep frames, dynamics, actions and goals in agreement."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

METERS_PER_PIXEL = 1 / 64
THICKEST, LONGEST = 4, 24  # of a bar, pixels


def augment(
    windows: TensorDictBase, generator: torch.Generator, max_shift: int = 6, mirror: bool = True
) -> TensorDictBase:
    """Mirror, shift and recolour windows ``[B, T]`` at random, each window in its own way.

    Each change is a symmetry of the scene: x -> 1 - x (and theta -> -theta), unless ``mirror`` is false; a shift by
    up to ``max_shift`` whole pixels (the border is repeated); a permutation of the colour channels. Pixels,
    dynamics, action and goal follow; ``agent_pos`` and ``state`` are left out.
    """
    batch = windows.shape[0]
    mirrored = _integers(0, 2, (batch,), generator).bool() & mirror
    shift = _integers(-max_shift, max_shift + 1, (batch, 2), generator)
    channels = _orders(batch, generator)

    sign = torch.ones(batch, 1, 3, device=generator.device)
    sign[:, 0, 0] -= 2.0 * mirrored  # x and theta change their signs under a reflection of x
    sign[:, 0, 2] -= 2.0 * mirrored
    offset = torch.zeros(batch, 1, 3, device=generator.device)
    offset[:, 0, :2] = shift * METERS_PER_PIXEL
    offset[:, 0, 0] += mirrored  # 1 - x
    windows = windows.exclude("agent_pos", "state")  # they hold poses that are not changed with the rest
    windows["pixels"] = _transform_pixels(windows["pixels"], mirrored, shift, channels)
    windows["action"] = windows["action"] * sign
    windows["goal"] = windows["goal"] * sign[..., :2] + offset[..., :2]
    dynamics = windows["dynamics"].apply(lambda x: x * sign.repeat(1, 1, 2))
    windows["dynamics"] = dynamics.set("position", dynamics["position"] + offset.repeat(1, 1, 2))
    return windows


def add_distractors(windows: TensorDictBase, generator: torch.Generator, most: int = 3) -> TensorDictBase:
    """Paint up to ``most`` bars on the background of each window ``[B, T]``, at rest and of one vivid colour.

    They lie behind all that is in the picture, and input and target get the same, so that a world model learns to
    tell objects that it does not know from cart and block. Windows must be drawn on one background colour.
    """
    pixels = windows["pixels"]
    background = _most_frequent(pixels[:, 0].flatten(2))[:, None, :, None]  # (B, 1, 3, 1)
    bars = _draw_bars(len(pixels), most, pixels.shape[-1], generator).flatten(1)  # (B, 64 * 64)
    # Only where a bar may be: a fixed number of places, of which the first are the bars'.
    places = min(most * THICKEST * LONGEST, bars.shape[1])
    inside, place = bars.to(torch.uint8).topk(places, sorted=False)  # (B, places)
    place = place[:, None, None].expand(*pixels.shape[:3], -1)
    there = pixels.flatten(3).gather(3, place)  # (B, T, 3, places)
    painted = (there == background).all(2, keepdim=True) & inside.bool()[:, None, None]
    colors = _draw_colors(len(pixels), generator)[:, None, :, None]
    painted = pixels.flatten(3).scatter(3, place, torch.where(painted, colors, there))
    return windows.clone(False).set("pixels", painted.view_as(pixels))


def _most_frequent(values: torch.Tensor) -> torch.Tensor:
    """That of the last axis, of uint8 ``[B, C, N]``; ``torch.mode`` would wait for a GPU."""
    counts = torch.zeros(*values.shape[:2], 256, dtype=torch.int32, device=values.device)
    return counts.scatter_add_(2, values.long(), counts.new_ones(()).expand_as(values)).argmax(2).byte()


def _draw_bars(batch: int, most: int, size: int, generator: torch.Generator) -> torch.Tensor:
    """Masks ``[B, size, size]`` of 0 to ``most`` upright or level bars each, 1 to 4 pixels thick."""
    shape = batch, most
    thick, long = _integers(1, THICKEST + 1, shape, generator), _integers(4, LONGEST + 1, shape, generator)
    upright = _integers(0, 2, shape, generator).bool()
    rows = _span(torch.where(upright, long, thick), size, generator)[..., None]
    columns = _span(torch.where(upright, thick, long), size, generator)[..., None, :]
    count = _integers(0, most + 1, (batch, 1), generator)
    chosen = (torch.arange(most, device=generator.device) < count)[..., None, None]
    return (rows & columns & chosen).any(1)


def _span(lengths: torch.Tensor, size: int, generator: torch.Generator) -> torch.Tensor:
    """Masks ``[..., size]`` of so many pixels from a random one on."""
    start = _integers(0, size, lengths.shape, generator).unsqueeze(-1)
    grid = torch.arange(size, device=generator.device)
    return (grid >= start) & (grid < start + lengths.unsqueeze(-1))


def _draw_colors(batch: int, generator: torch.Generator) -> torch.Tensor:
    """Vivid, as markers are: one channel at 180 or more, one at 80 or less, uint8 ``[B, 3]``."""
    shape = batch, 1
    values = [_integers(low, high, shape, generator) for low, high in ((180, 256), (0, 256), (0, 81))]
    return torch.cat(values, 1).gather(1, _orders(batch, generator)).to(torch.uint8)


def _orders(batch: int, generator: torch.Generator) -> torch.Tensor:
    """Permutations of three, ``[B, 3]``."""
    return torch.rand(batch, 3, generator=generator, device=generator.device).argsort(1)


def _integers(low: int, high: int, shape, generator: torch.Generator) -> torch.Tensor:
    return torch.randint(low, high, shape, generator=generator, device=generator.device)


def _transform_pixels(pixels, mirror, shift, channels) -> torch.Tensor:
    # For every output pixel the row, column and channel that it comes from; rows point down, y up.
    size = pixels.shape[-1]
    grid = torch.arange(size, device=pixels.device)
    columns = (grid - shift[:, :1]).clamp(0, size - 1)  # (B, W)
    columns = torch.where(mirror[:, None], size - 1 - columns, columns)
    rows = (grid + shift[:, 1:]).clamp(0, size - 1)
    source = (channels[:, :, None, None] * size + rows[:, None, :, None]) * size + columns[:, None, None, :]
    index = source.flatten(1)[:, None].expand(-1, pixels.shape[1], -1)
    return pixels.flatten(2).gather(2, index).view_as(pixels)
