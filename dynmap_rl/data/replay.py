"""Episodes as a TorchRL replay buffer."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import SliceSampler, Storage, TensorDictReplayBuffer, TensorStorage


def as_replay_buffer(
    episodes: TensorDictBase, batch: int, length: int, generator: torch.Generator | None = None
) -> TensorDictReplayBuffer:
    """Episodes ``[E, T]`` as a buffer whose ``sample()`` is ``batch`` random windows ``[batch, length]``.

    Each window lies in one episode; episodes, and the places in them, are equally likely. The buffer holds the
    episodes themselves, not a copy; samples are copies, with two entries more, ``[batch, length]``:
    ``trajectory``, the number of the episode, and ``index``. ``append_transform`` takes any transform of windows,
    :class:`dynmap_rl.envs.WorldModelTransform` too.

    Args:
        episodes: what :func:`dynmap_rl.data.load_dataset` gave.
        batch, length: B and T of a sample.
        generator: of the windows.

    Raises:
        ValueError: the episodes are shorter than ``length``.
    """
    count, steps = episodes.shape
    if steps < length:
        raise ValueError(f"windows of {length} steps do not fit into episodes of {steps}")
    number = torch.arange(count, device=episodes.device)[:, None].expand(count, steps)
    flat = episodes.copy().set("trajectory", number).reshape(-1)
    sampler = _WindowSampler(slice_len=length, traj_key="trajectory", truncated_key=None, cache_values=True)
    return TensorDictReplayBuffer(
        storage=TensorStorage(flat), sampler=sampler, batch_size=batch, generator=generator
    )


class _WindowSampler(SliceSampler):
    """TorchRL's slices, as windows ``[B, T]`` and not end to end."""

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict]:
        (index,), _ = super().sample(storage, batch_size * self.slice_len)
        return index.reshape(batch_size, self.slice_len), {}
