"""Windows of episodes, and augmentations that keep frames, dynamics, actions and goals in agreement."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from .augmentation import _integers


def sample_windows(
    episodes: TensorDictBase, batch: int, length: int, generator: torch.Generator
) -> TensorDictBase:
    """Random windows ``[batch, length]`` of episodes ``[E, T]``; every other one begins at t = 0.

    The generator is on the device of the episodes, here as in all that follows.

    Raises:
        ValueError: the episodes are shorter than ``length``.
    """
    count, steps = episodes.shape
    if steps < length:
        raise ValueError(f"windows of {length} steps do not fit into episodes of {steps}")
    episode = _integers(0, count, (batch, 1), generator)
    start = _integers(0, steps - length + 1, (batch, 1), generator)
    start[::2] = 0  # where the model's memory begins in control, and where most of the motion is
    index = (episode * steps + start + torch.arange(length, device=generator.device)).flatten()

    def select(values: torch.Tensor) -> torch.Tensor:
        return values.flatten(0, 1).index_select(0, index).unflatten(0, (batch, length))

    return episodes.apply(select, batch_size=[batch, length])  # three times as fast as indexing
