"""Augmentations that keep frames, dynamics, actions and goals in agreement."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

METERS_PER_PIXEL = 1 / 64
THICKEST, LONGEST = 4, 24  # bar, in pixels


def augment(
    windows: TensorDictBase,
    generator: torch.Generator,
    max_shift: int = 6,
    mirror: bool = True,
    recolor: bool = True,
) -> TensorDictBase:
    """Mirror, shift and recolour windows at random, each window in its own way.

    Each change is a symmetry of the scene: a reflection of x (and theta), a shift by whole pixels that repeats the
    border, a permutation of the colour channels. Pixels, dynamics, action and goal change together. ``agent_pos`` and
    ``state`` hold poses that do not, and are left out.

    Args:
        windows: ``[B, T]`` with ``pixels``, ``action`` ``[B, T, 3]``, ``goal`` ``[B, T, 2]`` and ``dynamics``
            ``[B, T, D]``: x, y and theta of one body after the other, or x and y of a point, in SI units.
        generator: source of the random numbers, on the device of the windows.
        max_shift: largest shift along either axis, in pixels.
        mirror: mirror every other window, on average.
        recolor: permute the colour channels.

    Returns:
        New windows ``[B, T]``.
    """
    batch = windows.shape[0]
    # All numbers are always drawn, so that an option does not change what the others draw.
    mirrored = integers(0, 2, (batch,), generator).bool() & mirror
    shift = integers(-max_shift, max_shift + 1, (batch, 2), generator)
    channels = _orders(batch, generator)
    if not recolor:
        channels = torch.arange(3, device=generator.device).expand(batch, 3)

    sign = torch.ones(batch, 1, 3, device=generator.device)
    sign[:, 0, 0] -= 2.0 * mirrored  # x and theta change their signs under a reflection of x
    sign[:, 0, 2] -= 2.0 * mirrored
    offset = torch.zeros(batch, 1, 3, device=generator.device)
    offset[:, 0, :2] = shift * METERS_PER_PIXEL
    offset[:, 0, 0] += mirrored  # 1 - x
    windows = windows.exclude("agent_pos", "state")
    windows["pixels"] = _transform_pixels(windows["pixels"], mirrored, shift, channels)
    for key in ("action", "expert_action"):
        if key in windows:
            windows[key] = windows[key] * sign
    windows["goal"] = windows["goal"] * sign[..., :2] + offset[..., :2]
    entries = torch.arange(windows["dynamics", "position"].shape[-1], device=generator.device) % 3
    dynamics = windows["dynamics"].apply(lambda x: x * sign[..., entries])
    windows["dynamics"] = dynamics.set("position", dynamics["position"] + offset[..., entries])
    return windows


def add_distractors(windows: TensorDictBase, generator: torch.Generator, most: int = 3) -> TensorDictBase:
    """Paint bars on the background of each window, at rest and of one vivid colour.

    The bars lie behind all objects. Input and target of a world model get the same bars, so that it learns to tell
    unknown objects from cart and block.

    Args:
        windows: ``[B, T]`` with ``pixels`` drawn on one background colour.
        generator: source of the random numbers, on the device of the windows.
        most: largest number of bars in a window; the number is drawn from 0 to ``most``.

    Returns:
        New windows ``[B, T]`` with the other entries of ``windows``.
    """
    pixels = windows["pixels"]
    background = _most_frequent(pixels[:, 0].flatten(2))[:, None, :, None]  # (B, 1, 3, 1)
    bars = _draw_bars(len(pixels), most, pixels.shape[-1], generator).flatten(1)  # (B, 64 * 64)
    # Only places that a bar can cover are compared and painted. Their number is fixed: no wait for a GPU.
    places = min(most * THICKEST * LONGEST, bars.shape[1])
    inside, place = bars.to(torch.uint8).topk(places, sorted=False)  # (B, places)
    place = place[:, None, None].expand(*pixels.shape[:3], -1)
    there = pixels.flatten(3).gather(3, place)  # (B, T, 3, places)
    painted = (there == background).all(2, keepdim=True) & inside.bool()[:, None, None]
    colors = _draw_colors(len(pixels), generator)[:, None, :, None]
    painted = pixels.flatten(3).scatter(3, place, torch.where(painted, colors, there))
    return windows.clone(False).set("pixels", painted.view_as(pixels))


def _most_frequent(values: torch.Tensor) -> torch.Tensor:
    """Return the most frequent value ``[B, C]`` of uint8 ``[B, C, N]``; ``torch.mode`` would wait for a GPU."""
    counts = torch.zeros(*values.shape[:2], 256, dtype=torch.int32, device=values.device)
    return counts.scatter_add_(2, values.long(), counts.new_ones(()).expand_as(values)).argmax(2).byte()


def _draw_bars(batch: int, most: int, size: int, generator: torch.Generator) -> torch.Tensor:
    """Draw masks ``[B, size, size]`` of 0 to ``most`` upright or level bars each, 1 to 4 pixels thick."""
    shape = batch, most
    thick, long = integers(1, THICKEST + 1, shape, generator), integers(4, LONGEST + 1, shape, generator)
    upright = integers(0, 2, shape, generator).bool()
    rows = _span(torch.where(upright, long, thick), size, generator)[..., None]
    columns = _span(torch.where(upright, thick, long), size, generator)[..., None, :]
    count = integers(0, most + 1, (batch, 1), generator)
    chosen = (torch.arange(most, device=generator.device) < count)[..., None, None]
    return (rows & columns & chosen).any(1)


def _span(lengths: torch.Tensor, size: int, generator: torch.Generator) -> torch.Tensor:
    """Draw masks ``[..., size]`` of ``lengths`` pixels from a random pixel on."""
    start = integers(0, size, lengths.shape, generator).unsqueeze(-1)
    grid = torch.arange(size, device=generator.device)
    return (grid >= start) & (grid < start + lengths.unsqueeze(-1))


def _draw_colors(batch: int, generator: torch.Generator) -> torch.Tensor:
    """Draw vivid colours, uint8 ``[B, 3]``: one channel at 180 or more, one at 80 or less."""
    shape = batch, 1
    values = [integers(low, high, shape, generator) for low, high in ((180, 256), (0, 256), (0, 81))]
    return torch.cat(values, 1).gather(1, _orders(batch, generator)).to(torch.uint8)


def _orders(batch: int, generator: torch.Generator) -> torch.Tensor:
    """Draw permutations of three, ``[B, 3]``."""
    return torch.rand(batch, 3, generator=generator, device=generator.device).argsort(1)


def integers(low: int, high: int, shape, generator: torch.Generator) -> torch.Tensor:
    """Draw whole numbers from ``low`` to ``high - 1`` on the device of the generator."""
    return torch.randint(low, high, shape, generator=generator, device=generator.device)


def _transform_pixels(
    pixels: torch.Tensor, mirror: torch.Tensor, shift: torch.Tensor, channels: torch.Tensor
) -> torch.Tensor:
    # Each output pixel is read from a row, a column and a channel. Rows point down, y points up.
    size = pixels.shape[-1]
    grid = torch.arange(size, device=pixels.device)
    columns = (grid - shift[:, :1]).clamp(0, size - 1)  # (B, W)
    columns = torch.where(mirror[:, None], size - 1 - columns, columns)
    rows = (grid + shift[:, 1:]).clamp(0, size - 1)
    source = (channels[:, :, None, None] * size + rows[:, None, :, None]) * size + columns[:, None, None, :]
    index = source.flatten(1)[:, None].expand(-1, pixels.shape[1], -1)
    return pixels.flatten(2).gather(2, index).view_as(pixels)
