"""Augmentations that keep frames, dynamics, actions and goals in agreement."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from .settings import Augmentation

METERS_PER_PIXEL = 1 / 64
POSES = ("agent_pos", "state")


def augment(
    windows: TensorDictBase, generator: torch.Generator, settings: Augmentation | None = None
) -> TensorDictBase:
    """Mirror, shift and recolour windows at random, each window in its own way.

    Each change is a symmetry of the scene: a reflection of x (and theta), a shift by whole pixels that repeats the
    border, a permutation of the colour channels. Pixels, dynamics, action and goal change together. ``agent_pos`` and
    ``state`` hold poses that do not. They are left out, and so are all next observations and dynamics.

    Args:
        windows: ``[B, T]`` with ``pixels`` and, to be mirrored or shifted, ``action`` ``[B, T, 3]``, ``goal`` ``[B, T, 2]``
            and ``dynamics`` ``[B, T, D]``: x, y and theta of one body after the other, or x and y of a point, in SI units.
        generator: source of the random numbers, on the device of the windows.
        settings: what is changed; default :class:`dynmap_rl.data.Augmentation`.

    Returns:
        New windows ``[B, T]``.

    Raises:
        ValueError: action or goal have other sizes, and the windows are to be mirrored or shifted.
    """
    settings = settings or Augmentation()
    max_shift, mirror, recolor = settings.max_shift, settings.mirror, settings.recolor
    batch = windows.shape[0]
    windows = windows.exclude(*POSES, *(("next", key) for key in (*POSES, "pixels", "goal", "dynamics")))
    sizes = {key: windows[key].shape[-1] for key in ("action", "goal") if key in windows}
    if (mirror or max_shift) and sizes != {"action": 3, "goal": 2}:
        raise ValueError(
            f"windows must have action [3] and goal [2] to be mirrored or shifted, got {sizes}; use Augmentation.off()"
        )
    if not (mirror or max_shift or recolor):
        return windows
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
    windows["pixels"] = _transform_pixels(windows["pixels"], mirrored, shift, channels)
    if not (mirror or max_shift):
        return windows
    for key in ("action", "expert_action"):
        if key in windows:
            windows[key] = windows[key] * sign
    windows["goal"] = windows["goal"] * sign[..., :2] + offset[..., :2]
    dynamics = {}
    for name, values in windows.get("dynamics", {}).items():
        entries = torch.arange(values.shape[-1], device=generator.device) % 3
        dynamics[name] = values * sign[..., entries]
        if name == "position":
            dynamics[name] = dynamics[name] + offset[..., entries]
    return windows.set("dynamics", dynamics) if dynamics else windows


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
    height, width = pixels.shape[-2:]
    across, down = (torch.arange(size, device=pixels.device) for size in (width, height))
    columns = (across - shift[:, :1]).clamp(0, width - 1)  # (B, W)
    columns = torch.where(mirror[:, None], width - 1 - columns, columns)
    rows = (down + shift[:, 1:]).clamp(0, height - 1)
    source = channels[:, :, None, None] * height + rows[:, None, :, None]
    source = source * width + columns[:, None, None, :]
    index = source.flatten(1)[:, None].expand(-1, pixels.shape[1], -1)
    return pixels.flatten(2).gather(2, index).view_as(pixels)
