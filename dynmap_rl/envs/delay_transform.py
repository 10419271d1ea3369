"""Late and lost frames in a TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from .delay import FrameDelay, check_delay, make_generator

NEVER = -1


class DelayTransform(Transform):
    """Transform that delays, jitters and drops the frames of an environment.

    ``pixels`` becomes the newest frame that has arrived, and ``delay`` int64 ``[..., 1]`` is written: the number of steps
    since that frame was taken. With ``bursts``, every frame that arrives in a step is delivered, once: ``pixels`` has
    the shape ``[..., M, *frame]`` and ``delay`` ``[..., M]``, M = 2 * jitter + 1, newest first. Places without a frame
    have a delay of -1. :class:`dynmap_rl.modules.DelayedActor` reads both forms.

    Args:
        delay: how frames arrive.
        seed: seed of the delays, or one seed for each world. The same seed gives a world the same delays with and
            without ``bursts``, and in :class:`dynmap_rl.envs.DelayFrames`. The seed of the environment does not
            determine the delays, which go on from episode to episode; a new transform repeats them.
        bursts: deliver every frame that arrives, rather than the newest.
        pixels: key of the frames, which is read and written.
        delay_key: key of the delays, which is written.

    Raises:
        ValueError: ``delay`` is no :class:`FrameDelay`, ``seed`` has another number of seeds than there are worlds, or the
            environment has no ``pixels``.
    """

    def __init__(
        self,
        delay: FrameDelay,
        seed: int | Sequence[int] | None = None,
        bursts: bool = False,
        pixels: NestedKey = "pixels",
        delay_key: NestedKey = "delay",
    ):
        super().__init__(in_keys=[pixels], out_keys=[pixels, delay_key])
        check_delay(delay)
        self.delay, self.seed, self.bursts = delay, seed, bursts
        self.places = 2 * delay.jitter + 1 if bursts else 1
        self._frames = None

    def _start(self, pixels: torch.Tensor) -> None:
        """Allocate a ring of the last frames of all worlds ``[N, ...]``."""
        count, length, device = len(pixels), self.delay.longest + 1, pixels.device
        self._now = 0  # step of all worlds; episodes may begin at any step
        self._frames = pixels.new_zeros(length, *pixels.shape)
        self._arrival = torch.full((length, count), NEVER, device=device)
        self._newest, self._taken = pixels.clone(), torch.full((count,), NEVER, device=device)
        self._began = torch.zeros(count, dtype=torch.int64, device=device)  # step of the first frame
        if self.seed is None or isinstance(self.seed, Integral):
            self._generators = [make_generator(self.seed, world) for world in range(count)]
        else:
            self._generators = [make_generator(int(seed)) for seed in self.seed]
        if len(self._generators) != count:
            raise ValueError(
                f"seed must have one seed for each of {count} worlds, got {len(self._generators)}"
            )

    def clone(self) -> DelayTransform:
        """Return a transform with the same settings and no frames."""
        other = super().clone()
        other._frames = None
        return other

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        pixels = self._frames_of(tensordict_reset)
        ring = self._frames
        if ring is None or (ring.shape[1:], ring.device) != (pixels.shape, pixels.device):
            self._start(pixels)  # also where a used transform gets another environment or device
        mask = tensordict.get("_reset", torch.ones(len(pixels), dtype=torch.bool)).flatten()
        slot = self._now % len(self._frames)
        self._arrival[:, mask], self._taken[mask], self._began[mask] = NEVER, NEVER, self._now
        self._arrival[slot, mask], self._frames[slot, mask] = self._now, pixels[mask]
        # TorchRL keeps the old entries of the worlds that are not reset.
        return self._deliver(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        pixels = self._frames_of(next_tensordict)
        self._now += 1
        slot = self._now % len(self._frames)
        delays = [self.delay.draw(generator) for generator in self._generators]
        arrival = [NEVER if delay is None else self._now + delay for delay in delays]
        self._arrival[slot] = torch.tensor(arrival, device=pixels.device)
        self._frames[slot] = pixels
        return self._deliver(next_tensordict)

    def _frames_of(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Return the frames of all worlds ``[N, ...]``; an environment without batch dimensions is one world."""
        self._check_frames(tensordict)
        pixels = tensordict[self.in_keys[0]]
        return pixels.reshape(tensordict.batch_size.numel(), *pixels.shape[tensordict.ndim :])

    def _check_frames(self, observation: TensorDictBase | Composite) -> None:
        if self.in_keys[0] not in observation.keys(True):
            raise ValueError(
                f"{self.in_keys[0]} must be an observation of the environment: make it with from_pixels=True"
            )

    def _deliver(self, tensordict: TensorDictBase) -> TensorDictBase:
        length, batch = len(self._frames), tensordict.batch_size
        ages = torch.arange(length, device=self._arrival.device)
        slots = (self._now - ages) % length
        arrived = (self._arrival[slots] == self._now).T  # (N, length), by age
        delay = (
            torch.where(arrived, ages, length).sort(1).values[:, : self.places]
        )  # (N, M), the newest first
        delay = delay.masked_fill(delay == length, NEVER)
        worlds, places = (delay >= 0).nonzero(as_tuple=True)
        frames = self._frames[slots[delay[worlds, places]], worlds]
        if self.bursts:
            pixels = self._newest.new_zeros(*delay.shape, *self._newest.shape[1:])
            pixels[worlds, places] = frames
        else:
            newer = self._now - delay[worlds, 0] > self._taken[worlds]
            worlds, frames = worlds[newer], frames[newer]
            self._newest[worlds], self._taken[worlds] = frames, self._now - delay[worlds, 0]
            pixels, delay = self._newest.clone(), (self._now - self._taken)[:, None]
        wrong = (delay >= 0) & (self._now - delay != self._began[:, None])
        delay = delay + self.delay.error * wrong
        tensordict.set(self.out_keys[0], pixels.reshape(*batch, *pixels.shape[1:]))
        return tensordict.set(self.out_keys[1], delay.reshape(*batch, self.places))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        self._check_frames(observation_spec)
        shape, pixels = observation_spec.shape, observation_spec[self.in_keys[0]]
        if self.bursts:
            frame = pixels.shape[len(shape) :]
            pixels = pixels.unsqueeze(len(shape)).expand(*shape, self.places, *frame)
        observation_spec[self.out_keys[0]] = pixels
        observation_spec[self.out_keys[1]] = Unbounded(
            (*shape, self.places), dtype=torch.int64, device=observation_spec.device
        )
        return observation_spec
