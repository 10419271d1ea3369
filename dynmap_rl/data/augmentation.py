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


def augment(windows: TensorDictBase, generator: torch.Generator, max_shift: int = 6) -> TensorDictBase:
    """Mirror, shift and recolour windows ``[B, T]`` at random, each window in its own way.

    Each change is a symmetry of the scene: x -> 1 - x (and theta -> -theta), a shift by up to ``max_shift`` whole
    pixels (the border is repeated), a permutation of the colour channels. Pixels, dynamics, action and goal follow;
    ``agent_pos`` and ``state`` are left out.
    """
    batch = windows.shape[0]
    mirror = torch.rand(batch, generator=generator) < 0.5
    shift = torch.randint(-max_shift, max_shift + 1, (batch, 2), generator=generator)
    channels = torch.stack([torch.randperm(3, generator=generator) for _ in range(batch)])

    sign = torch.where(mirror[:, None, None], MIRROR, torch.ones(3))  # (B, 1, 3)
    offset = torch.zeros(batch, 1, 3)
    offset[:, 0, :2] = shift * METERS_PER_PIXEL
    offset[:, 0, 0] += mirror  # 1 - x
    windows = windows.exclude("agent_pos", "state")  # they hold poses that are not changed with the rest
    windows["pixels"] = _transform_pixels(windows["pixels"], mirror, shift, channels)
    windows["action"] = windows["action"] * sign
    windows["goal"] = windows["goal"] * sign[..., :2] + offset[..., :2]
    dynamics = windows["dynamics"].apply(lambda x: x * sign.repeat(1, 1, 2))
    windows["dynamics"] = dynamics.set("position", dynamics["position"] + offset.repeat(1, 1, 2))
    return windows


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
