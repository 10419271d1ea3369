"""Windows of episodes, and augmentations that keep frames, dynamics, actions and goals in agreement."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

METERS_PER_PIXEL = 1 / 64
MIRROR = torch.tensor([-1.0, 1.0, -1.0])  # x, y, theta under a reflection of x


def sample_windows(
    episodes: TensorDictBase, batch: int, length: int, generator: torch.Generator
) -> TensorDictBase:
    """Random windows ``[batch, length]`` of episodes ``[E, T]``; every other one begins at t = 0.

    Raises:
        ValueError: the episodes are shorter than ``length``.
    """
    count, steps = episodes.shape
    if steps < length:
        raise ValueError(f"windows of {length} steps do not fit into episodes of {steps}")
    episode = torch.randint(count, (batch, 1), generator=generator)
    start = torch.randint(steps - length + 1, (batch, 1), generator=generator)
    start[::2] = 0  # where the model's memory begins in control, and where most of the motion is
    return episodes[episode, start + torch.arange(length)]


def augment(
    windows: TensorDictBase, generator: torch.Generator, max_shift: int = 6, mirror: bool = True
) -> TensorDictBase:
    """Mirror, shift and recolour windows ``[B, T]`` at random, each window in its own way.

    Each change is a symmetry of the scene: x -> 1 - x (and theta -> -theta), unless ``mirror`` is false; a shift by
    up to ``max_shift`` whole pixels (the border is repeated); a permutation of the colour channels. Pixels,
    dynamics, action and goal follow; ``agent_pos`` and ``state`` are left out.
    """
    batch = windows.shape[0]
    mirrored = (torch.rand(batch, generator=generator) < 0.5) & mirror
    shift = torch.randint(-max_shift, max_shift + 1, (batch, 2), generator=generator)
    channels = torch.stack([torch.randperm(3, generator=generator) for _ in range(batch)])

    sign = torch.where(mirrored[:, None, None], MIRROR, torch.ones(3))  # (B, 1, 3)
    offset = torch.zeros(batch, 1, 3)
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
    pixels = windows["pixels"].clone()
    for window in pixels:
        scene = _draw_bars(most, generator)
        background = window[0].flatten(1).mode(1).values[:, None, None]
        free = (window == background).all(1)  # (T, H, W)
        window[:] = torch.where((free & scene).unsqueeze(1), _draw_color(generator), window)
    return windows.clone(False).set("pixels", pixels)


def _draw_bars(most: int, generator: torch.Generator, size: int = 64) -> torch.Tensor:
    """A mask ``[size, size]`` of 0 to ``most`` upright or level bars, 1 to 4 pixels thick."""
    mask = torch.zeros(size, size, dtype=torch.bool)
    for _ in range(_integer(0, most + 1, generator)):
        sides = [_integer(1, 5, generator), _integer(4, 25, generator)]
        height, width = sides if _integer(0, 2, generator) else sides[::-1]
        row, column = _integer(0, size, generator), _integer(0, size, generator)
        mask[row : row + height, column : column + width] = True
    return mask


def _draw_color(generator: torch.Generator) -> torch.Tensor:
    """Vivid, as markers are: one channel at 180 or more, one at 80 or less, ``[3, 1, 1]``."""
    channels = _integer(180, 256, generator), _integer(0, 256, generator), _integer(0, 81, generator)
    order = torch.randperm(3, generator=generator)
    return torch.tensor(channels, dtype=torch.uint8)[order, None, None]


def _integer(low: int, high: int, generator: torch.Generator) -> int:
    return int(torch.randint(low, high, (), generator=generator))


def _transform_pixels(pixels, mirror, shift, channels) -> torch.Tensor:
    # For every output pixel the row, column and channel that it comes from; rows point down, y up.
    size = pixels.shape[-1]
    grid = torch.arange(size)
    columns = (grid - shift[:, :1]).clamp(0, size - 1)  # (B, W)
    columns = torch.where(mirror[:, None], size - 1 - columns, columns)
    rows = (grid + shift[:, 1:]).clamp(0, size - 1)
    out = torch.empty_like(pixels)
    for i in range(len(pixels)):
        index = channels[i][:, None, None], rows[i][:, None], columns[i]
        out[i] = pixels[i][:, *index]
    return out
