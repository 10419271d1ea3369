"""Episodes as a TorchRL replay buffer."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import ImmutableDatasetWriter, SliceSampler, Storage, TensorDictReplayBuffer, TensorStorage

from .windows import check_length


def as_replay_buffer(
    episodes: TensorDictBase, batch: int, length: int, generator: torch.Generator | None = None
) -> TensorDictReplayBuffer:
    """Make a replay buffer of episodes, whose ``sample()`` returns random windows ``[batch, length]``.

    Each window lies in one episode; all episodes, and all places in an episode, are equally likely. The buffer holds the
    episodes themselves, not a copy, unless they are a slice in time. Samples are copies, with two more entries:
    ``trajectory`` ``[batch, length]``, the number of the episode, and ``index``. ``append_transform`` takes any transform
    of windows, such as :class:`dynmap_rl.envs.WorldModelTransform`.

    Losses on single transitions need next observations, which the episodes do not repeat. For these use TorchRL's own
    buffer with ``SliceSampler`` and ``NextStateReconstructor`` (see ``dynmap_rl/data/README.md``).

    Args:
        episodes: ``[E, T]``, as :func:`dynmap_rl.data.load_dataset` returns them.
        batch: number of windows of a sample.
        length: steps of a window.
        generator: source of the random numbers; by default torch's own.

    Raises:
        ValueError: the episodes are not ``[E, T]``, are shorter than ``length``, or end before their last step.
    """
    if episodes.ndim != 2:
        raise ValueError(f"episodes must be [E, T], got {list(episodes.shape)}")
    count, steps = episodes.shape
    check_length(length, steps)
    if ("next", "done") in episodes.keys(True) and episodes["next", "done"][:, :-1].any():
        raise ValueError(
            'each row must be one episode, but ("next", "done") is true before its last step; use TorchRL\'s buffer with '
            "SliceSampler"
        )
    number = torch.arange(count, device=episodes.device)[:, None].expand(count, steps)
    flat = episodes.copy().set("trajectory", number).reshape(-1)
    sampler = _WindowSampler(slice_len=length, traj_key="trajectory", truncated_key=None, cache_values=True)
    return TensorDictReplayBuffer(
        storage=TensorStorage(flat),
        sampler=sampler,
        writer=ImmutableDatasetWriter(),
        batch_size=batch,
        generator=generator,
    )


class _WindowSampler(SliceSampler):
    """Sampler of TorchRL's slices in the shape ``[B, T]``."""

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict]:
        (index,), _ = super().sample(storage, batch_size * self.slice_len)
        return index.reshape(batch_size, self.slice_len), {}
