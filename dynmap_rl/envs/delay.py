"""Late and lost frames: their settings, and a Gymnasium wrapper."""

from __future__ import annotations

from collections import defaultdict
from copy import deepcopy
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import gymnasium as gym
import numpy as np

from dynmap_rl.utils.settings import check_at_least


@dataclass(frozen=True)
class FrameDelay:
    """How frames arrive: the frame taken at step t arrives at step t + ``steps`` + j, or never.

    The number j is drawn for each frame from ``-jitter`` to ``jitter``, so that frames overtake each other and arrive in
    bursts. The first frame of an episode arrives at once, as a robot waits for it before it moves. Frames are
    reported to be ``error`` steps older than they are, as by a wrong clock; the first frame is not.
    """

    # Mean delay in control steps.
    steps: int = 0
    # Largest deviation from it, in control steps; at most `steps`.
    jitter: int = 0
    # Probability that a frame is lost.
    lost: float = 0.0
    # Error of the reported delays, in control steps; not of the first frame's.
    error: int = 0

    def __post_init__(self):
        for name in ("steps", "jitter", "error"):
            if not isinstance(value := getattr(self, name), Integral):
                raise ValueError(f"FrameDelay.{name} must be a whole number of control steps, got {value}")
        check_at_least(self, 0, "steps", "jitter")
        if self.jitter > self.steps:
            raise ValueError(
                f"FrameDelay.jitter must be at most the delay of {self.steps} steps, got {self.jitter}"
            )
        if self.steps - self.jitter + self.error < 0:
            raise ValueError(
                f"FrameDelay.error must be at least {self.jitter - self.steps}, so that no reported delay is negative, "
                f"got {self.error}"
            )
        if not 0 <= self.lost <= 1:
            raise ValueError(f"FrameDelay.lost must be a probability, 0 to 1, got {self.lost}")

    @property
    def longest(self) -> int:
        """Longest delay in control steps, true or reported."""
        return self.steps + self.jitter + max(self.error, 0)

    def draw(self, generator: np.random.Generator) -> int | None:
        """Draw the delay of a frame in control steps; None for a frame that is lost."""
        lost = generator.random() < self.lost
        delay = self.steps + int(generator.integers(-self.jitter, self.jitter, endpoint=True))
        return None if lost else delay


def check_delay(delay: FrameDelay) -> None:
    """Raise ``ValueError`` for what is no delay, such as a number."""
    if not isinstance(delay, FrameDelay):
        raise ValueError(f"delay must be a FrameDelay, such as FrameDelay(steps=6), got {delay!r}")


class DelayFrames(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Wrapper that delays, jitters and drops the frames of a Gymnasium environment.

    The observation has the newest frame that has arrived. ``info["delay"]`` is the number of steps since that frame was
    taken. ``info["arrived"]`` is a list of all frames that arrive in this step, each a tuple of its delay and the frame.
    ``reset(seed=...)`` determines the delays, too. Everything else, such as ``agent_pos``, is not delayed.

    Args:
        env: environment whose observations are frames, or dicts with a frame.
        delay: how frames arrive.
        key: name of the frame in a dict of observations. Observations that are no dict are delayed as a whole.

    Raises:
        ValueError: ``delay`` is no :class:`FrameDelay`, or the observations have no ``key``.
    """

    def __init__(self, env: gym.Env, delay: FrameDelay, key: str = "pixels"):
        gym.utils.RecordConstructorArgs.__init__(self, delay=delay, key=key)
        gym.Wrapper.__init__(self, env)
        check_delay(delay)
        space = env.observation_space
        if isinstance(space, gym.spaces.Dict) and key not in space.spaces:
            raise ValueError(f"key must be one of {', '.join(space.spaces)}, got {key!r}")
        self.delay, self.key = delay, key if isinstance(space, gym.spaces.Dict) else None
        self._generator = make_generator(None)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        if seed is not None:
            self._generator = make_generator(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        self._step, self._taken = 0, -1
        # Steps at which frames were taken, by that of arrival. A frame may be a dict, of several cameras.
        self._due: dict[int, list[int]] = defaultdict(list)
        self._frames: dict[int, Any] = {}
        return self._deliver(observation, info, delay=0)

    def step(self, action):
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        observation, info = self._deliver(observation, info, self.delay.draw(self._generator))
        return observation, reward, terminated, truncated, info

    def _deliver(self, observation, info: dict, delay: int | None) -> tuple[Any, dict]:
        """Send a new frame off, and return what arrives in this step."""
        if delay is not None:
            self._due[self._step + delay].append(self._step)
            frame = observation if self.key is None else observation[self.key]
            self._frames[self._step] = deepcopy(frame)  # an environment may use its buffer again
        arrived = {taken: self._frames.pop(taken) for taken in sorted(self._due.pop(self._step, ()))}
        if arrived and max(arrived) > self._taken:
            self._taken = max(arrived)
            self._newest = deepcopy(arrived[self._taken])  # a caller may change what it gets
        info |= {
            "delay": np.int64(self._report(self._taken)),
            "arrived": [(self._report(taken), frame) for taken, frame in arrived.items()],
        }
        newest = deepcopy(self._newest)
        return newest if self.key is None else observation | {self.key: newest}, info

    def _report(self, taken: int) -> int:
        """Return the reported delay of a frame by the step at which it was taken."""
        return self._step - taken + (self.delay.error if taken else 0)


DELAYS = 4  # number of this stream of random numbers; recordings use 1 to 3 with the same seeds


def make_generator(seed: int | None, world: int = 0) -> np.random.Generator:
    """Make the generator of the delays of one world.

    Its numbers are independent of those of the scene with the same seed. NumPy pads seeds with zeros, so that
    ``[seed, 0]`` alone would be the seed of the scene.
    """
    return np.random.default_rng(None if seed is None else [seed, DELAYS, world])
