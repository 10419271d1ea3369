"""Random windows of episodes."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from .augmentation import integers


def sample_windows(
    episodes: TensorDictBase,
    batch: int,
    length: int,
    generator: torch.Generator,
    part: slice = slice(None),
) -> TensorDictBase:
    """Draw windows of episodes; every other window, or a single one half of the time, begins at its episode's first step.

    Args:
        episodes: ``[E, T]``.
        batch: number of windows B.
        length: steps of a window.
        generator: source of the random numbers.
        part: windows of the batch that are wanted; the others are drawn but not copied.

    Returns:
        Copies ``[batch, length]``, or as many as ``part`` selects.

    Raises:
        ValueError: the episodes are shorter than ``length``.
    """
    count, steps = episodes.shape
    check_length(length, steps)
    episode = integers(0, count, (batch, 1), generator)
    start = integers(0, steps - length + 1, (batch, 1), generator)
    first = slice(None, None, 2) if batch > 1 or integers(0, 2, (), generator) else slice(0)
    start[first] = 0  # where memory is empty, as when control begins, and where most of the motion is
    index = (episode * steps + start + torch.arange(length, device=generator.device))[part]

    def select(values: torch.Tensor) -> torch.Tensor:
        flat = index.flatten().to(values.device)
        return values.flatten(0, 1).index_select(0, flat).unflatten(0, index.shape)

    return episodes.apply(select, batch_size=index.shape)  # three times as fast as indexing


def check_length(length: int, steps: int) -> None:
    """Raise ``ValueError`` for windows that are longer than the episodes."""
    if steps < length:
        raise ValueError(
            f"windows must be at most as long as the episodes ({steps} steps), got {length}; use shorter windows"
        )
