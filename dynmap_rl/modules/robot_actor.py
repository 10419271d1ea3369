"""World model and policy in the control loop of a robot, whose frames have timestamps."""

from __future__ import annotations

import math
import warnings
from collections import deque

import numpy as np
import torch
from tensordict import TensorDict

from .delayed_actor import DelayedActor

FAR = 3  # times the half range of the goals in the demonstrations
LATE = 0.75  # part of a period by which a call may be late without a missed step


class RobotActor:
    """Delayed actor as a plain object: frames with timestamps in, actions out.

    .. code-block:: python

        robot = RobotActor(DelayedActor(load_actor("balance_reaching"), max_delay=10))
        robot.reset(goal)
        robot.observe(frame, timestamp)  # whenever a frame arrives, in any order
        action = robot.act(now)  # once in each control step

    The episode begins with the first call of :meth:`act`, which needs a frame. The robot is at rest before it, so that
    the newest frame then counts as the frame of that moment. Every later frame belongs to the call of :meth:`act` that is
    nearest to its timestamp. If several frames arrive together for a call, the nearest is used. Frames older than
    ``max_delay`` steps are not used; after ``max_delay`` of them in a row, :meth:`act` warns that two clocks may differ.

    A call may be late by up to three quarters of a period. Where it is later, control steps were missed, which count as
    steps with an action of zero, or with the last one again (``hold``); after a longer gap than ``max_delay`` steps, the
    robot is at rest, and only the last ``max_delay`` of them count. After ten late calls in a row, :meth:`act` warns that
    ``period`` may be wrong.

    Args:
        actor: world model and policy; its ``max_delay`` is the age of the oldest frames that are used.
        period: duration of a control step, in the unit of the timestamps (s): that of the demonstrations, 1 / fps.
        hold: whether a missed step repeats the last action, as a robot does whose actions are targets; those of cart and
            block are changes, which end.

    Raises:
        TypeError: ``actor`` is no :class:`DelayedActor`.
        ValueError: ``period`` is not positive, or ``max_delay`` is 0, so that no late frame would be used.
    """

    def __init__(self, actor: DelayedActor, period: float = 0.05, hold: bool = False):
        if not isinstance(actor, DelayedActor):
            raise TypeError(f"actor must be a DelayedActor, got {type(actor).__name__}")
        if actor.max_delay < 1:
            raise ValueError(
                "actor must have a max_delay of at least 1 step; give DelayedActor max_delay=..."
            )
        if not period > 0:
            raise ValueError(f"period must be positive, got {period}")
        self.actor, self.period, self.hold = actor.eval(), period, hold
        self.device = next(actor.parameters()).device
        self.goal = None

    def reset(self, goal: np.ndarray, since: float = -math.inf) -> None:
        """Forget everything and take a new goal.

        Args:
            goal: ``[G]`` (SI units).
            since: time from which on frames are of the new episode; frames that were taken before it are not used.

        Warns where the goal is far outside those of the demonstrations.

        Raises:
            ValueError: the goal has another size than the policy's, or is not finite.
        """
        goal = torch.as_tensor(
            goal, dtype=torch.float32, device=self.device
        ).clone()  # its owner may change it
        policy = self.actor.actor.latent_actor.policy
        # A policy of one's own may not say how large its goal is.
        size = policy.goal.size if hasattr(policy, "goal") else goal.numel()
        if goal.shape != (size,) or not goal.isfinite().all():
            raise ValueError(f"goal must be {size} finite numbers, got {goal.tolist()}")
        if hasattr(policy, "goal") and (policy.goal.normalize(goal).abs() > FAR).any():
            warnings.warn(
                f"the goal {goal.tolist()} is far outside those of the demonstrations; has it their unit?",
                stacklevel=2,
            )
        self.goal, self.unused, self.late = goal, 0, 0
        self.since, self.memory, self.actor.blind = since, TensorDict({}, device=self.device), False
        self.frames: list[tuple[float, np.ndarray]] = []
        self.times: deque[float] = deque(maxlen=self.actor.max_delay + 1)  # of the last steps

    def observe(self, frame: np.ndarray, timestamp: float) -> None:
        """Take a frame, uint8 ``[S, cameras * S, 3]``, and the time at which it was taken.

        Raises:
            ValueError: the frame has another form or size, the time is not finite, or :meth:`reset` was not called.
        """
        frame = np.array(frame)  # a camera may use its buffer again
        model = self.actor.world_model
        shape = model.image_size, model.cameras * model.image_size, 3
        if frame.dtype != np.uint8 or frame.shape != shape:
            raise ValueError(f"frame must be uint8 {list(shape)}, got {frame.dtype} {list(frame.shape)}")
        if not math.isfinite(timestamp):
            raise ValueError(f"timestamp must be finite, got {timestamp}")
        self._check_reset()
        if timestamp >= self.since:
            self.frames.append((timestamp, frame))
            # While act is not called, frames that can no longer be used are forgotten.
            oldest = max(time for time, _ in self.frames) - (self.actor.max_delay + 2) * self.period
            self.frames = [pair for pair in self.frames if pair[0] >= oldest]

    @torch.no_grad()
    def act(self, now: float) -> np.ndarray:
        """Return the action of the control step that begins now, float32 ``[A]`` (SI units).

        It is cut to the range of the demonstrations' actions: the limits of a task, or, for a robot dataset, all but one in a
        thousand of the values at either end.

        Raises:
            ValueError: no frame has arrived before the first action, ``now`` is not finite or not after the last call, a
                frame was taken more than a period after ``now``, or :meth:`reset` was not called.
        """
        self._check_reset()
        if not math.isfinite(now):
            raise ValueError(f"now must be finite, got {now}")
        if (newest := max((time for time, _ in self.frames), default=now)) > now + self.period:
            self.frames = []
            raise ValueError(
                f"a frame of {newest} cannot have arrived at {now}; observe and act need one clock"
            )
        if self.times and not now > self.times[-1]:
            raise ValueError(
                f"now must be after the last call at {self.times[-1]}, got {now}; use a monotonic clock such as "
                "time.monotonic(), or call reset"
            )
        if self.times:
            self._miss_steps(now)
        elif self.frames:
            self.frames = [(now, max(self.frames, key=lambda pair: pair[0])[1])]
            self.step, self.start = 0, now
        else:
            raise ValueError("the first action needs a frame; call observe before act")
        self.times.append(now)
        td = self.actor(self._receive())
        known = self.actor.world_model.transition.action
        self.memory, action = td["next"], td[self.actor.actor.action]
        self.action = action.clamp(known.center - known.scale, known.center + known.scale)
        return self.action.cpu().numpy()

    def _check_reset(self) -> None:
        if self.goal is None:
            raise ValueError("an episode needs a goal; call reset first")

    def _receive(self) -> TensorDict:
        """Return memory, goal, and the frames that have arrived since the last step."""
        td, keys = self.memory.copy().set(self.actor.actor.latent_actor.goal, self.goal), self.actor.actor
        frames, self.frames = self.frames, []
        nearest = {}  # frame by its delay
        for timestamp, frame in frames:
            delay, distance = self._delay(timestamp)
            if delay not in nearest or distance < nearest[delay][0]:
                nearest[delay] = distance, frame
        self.unused = 0 if any(delay >= 0 for delay in nearest) else self.unused + len(frames)
        if self.unused >= self.actor.max_delay > self.unused - len(frames):
            warnings.warn(
                f"the last {self.unused} frames were too old to be used; do observe and act use one clock?",
                stacklevel=3,
            )
        if nearest:
            pixels = torch.from_numpy(np.stack([frame for _, frame in nearest.values()])).movedim(-1, -3)
            td.set(keys.pixels, pixels).set(self.actor.delay_key, torch.tensor([*nearest]))
        return td

    def _delay(self, timestamp: float) -> tuple[int, float]:
        """Return the steps from a timestamp to the present, and how far it is from its step.

        The steps are -1 for times before all remembered steps.
        """
        distances = [abs(time - timestamp) for time in reversed(self.times)]
        steps = min(range(len(distances)), key=distances.__getitem__)
        return -1 if timestamp < self.times[0] - self.period / 2 else steps, distances[steps]

    def _miss_steps(self, now: float) -> None:
        """Predict the control steps without an action since the last call.

        They are counted on the beat that began with the episode: counted from call to call, a call that is late and one
        that is early again would be three steps.
        """
        last = self.times[-1]
        steps = max(1, math.floor((now - self.start) / self.period + 1 - LATE) - self.step)
        self.late = self.late + 1 if steps > 1 else 0
        if self.late == 10:
            warnings.warn(
                f"the last 10 calls of act came more than a period of {self.period} after the one before; is it 1 / fps of "
                "the demonstrations?",
                stacklevel=3,
            )
        for i in range(max(1, steps - self.actor.max_delay), steps):
            self.times.append(last + i * (now - last) / steps)
            td = self.actor.observe(self.memory.copy())
            action = self.action if self.hold else torch.zeros_like(self.action)
            td = self.actor.predict(td.set(self.actor.actor.action, action))
            # Without an action, the policy's memory stays as it is.
            self.memory.update(td["next"])
        self.step += steps
        # The beat is that of the earliest calls.
        self.start = min(self.start, now - (self.step - 1 + LATE) * self.period)
