"""World model and policy in the control loop of a robot, whose frames have timestamps."""

from __future__ import annotations

from collections import deque

import numpy as np
import torch
from tensordict import TensorDict

from .delayed_actor import DelayedActor


class RobotActor:
    """Delayed actor as a plain object: frames with timestamps in, actions out.

    .. code-block:: python

        robot = RobotActor(DelayedActor(load_actor("balance_reaching"), max_delay=10))
        robot.reset(goal)
        robot.observe(frame, timestamp)  # whenever a frame arrives, in any order
        action = robot.act(now)  # once in each control step

    The episode begins with the first call of :meth:`act`, which needs a frame. The robot is at rest before it, so that
    the newest frame then counts as the frame of that moment. Every later frame belongs to the call of :meth:`act` that is
    nearest to its timestamp; frames older than ``max_delay`` steps are not used. Where a call comes so late that control
    steps were missed, these count as steps with an action of zero; after a longer gap than ``max_delay`` steps, the robot
    is at rest, and only the last ``max_delay`` of them count.

    Args:
        actor: world model and policy.
        period: duration of a control step, in the unit of the timestamps (s).
    """

    def __init__(self, actor: DelayedActor, period: float = 0.05):
        self.actor, self.period = actor.eval(), period
        self.device = next(actor.parameters()).device

    def reset(self, goal: np.ndarray) -> None:
        """Forget everything and take a new goal, ``[G]`` (SI units)."""
        self.goal = torch.as_tensor(goal, dtype=torch.float32, device=self.device)
        self.memory = TensorDict({}, device=self.device)
        self.frames: list[tuple[float, np.ndarray]] = []
        self.times: deque[float] = deque(maxlen=self.actor.max_delay + 1)  # of the last steps

    def observe(self, frame: np.ndarray, timestamp: float) -> None:
        """Take a frame, uint8 ``[64, 64, 3]``, and the time at which it was taken."""
        self.frames.append((timestamp, frame))

    @torch.no_grad()
    def act(self, now: float) -> np.ndarray:
        """Return the action of the control step that begins now, float32 ``[A]`` (SI units).

        Raises:
            ValueError: no frame has arrived before the first action.
        """
        if self.times:
            self._miss_steps(now)
        elif self.frames:
            self.frames = [(now, max(self.frames, key=lambda pair: pair[0])[1])]
        else:
            raise ValueError("the first action needs a frame; call observe before act")
        self.times.append(now)
        td = self.actor(self._receive())
        self.memory = td["next"]
        return td[self.actor.actor.action].cpu().numpy()

    def _receive(self) -> TensorDict:
        """Return memory, goal, and the frames that have arrived since the last step."""
        td, keys = self.memory.copy().set(self.actor.actor.latent_actor.goal, self.goal), self.actor.actor
        frames, self.frames = self.frames, []
        if frames:
            pixels = torch.from_numpy(np.stack([frame for _, frame in frames])).movedim(-1, -3)
            delays = torch.tensor([self._delay(timestamp) for timestamp, _ in frames])
            td.set(keys.pixels, pixels).set(self.actor.delay_key, delays)
        return td

    def _delay(self, timestamp: float) -> int:
        """Return the steps from a timestamp to the present; -1 for times before all remembered steps."""
        if timestamp < self.times[0] - self.period / 2:
            return -1
        return min(range(len(self.times)), key=lambda steps: abs(self.times[-1 - steps] - timestamp))

    def _miss_steps(self, now: float) -> None:
        """Predict the control steps without an action since the last call."""
        last = self.times[-1]
        steps = round((now - last) / self.period)
        for i in range(max(1, steps - self.actor.max_delay), steps):
            self.times.append(last + i * (now - last) / steps)
            td = self.actor.observe(self.memory.copy())
            size = self.actor.world_model.transition.action.size
            td = self.actor.predict(td.set(self.actor.actor.action, torch.zeros(size)))
            # Without an action, the policy's memory stays as it is.
            self.memory.update(td["next"])
