"""World model and policy that answer a frame with the actions of several steps."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from .actor import Actor


class ChunkActor:
    """Actor whose call returns a chunk: the actions of the step of the frame and of the steps after it.

    After the first step of a chunk, the world model is rolled forward with the policy's own actions, and its predicted
    latents take the place of frames. Where a chunk takes ``delay`` steps to arrive at the robot, the robot executes the
    previous chunk meanwhile. Chunks therefore begin with the ``delay`` actions that the previous chunk has for these
    steps, and the policy acts from the step after them. Memories go on from chunk to chunk. With a new chunk in every
    step, the actions are those of :class:`DelayedActor` with the same delay.

    Args:
        actor: world model and policy.
        size: steps of a chunk.
        delay: steps from a frame to the first action of its chunk that can still be executed.

    Raises:
        TypeError: ``actor`` is no :class:`Actor`.
        ValueError: ``delay`` is negative or not below ``size``.
    """

    def __init__(self, actor: Actor, size: int, delay: int = 0):
        if not isinstance(actor, Actor):
            raise TypeError(f"actor must be an Actor, got {type(actor).__name__}")
        if not 0 <= delay < size:
            raise ValueError(f"delay must be between 0 and size - 1, got {delay} and a size of {size}")
        self.actor, self.size, self.delay = actor, size, delay
        self.reset()

    def reset(self) -> None:
        """Forget everything, as an episode begins."""
        self.steps: dict[int, TensorDict] = {}  # of the last chunk, and the step before it
        self.first = 0  # step of the last frame

    @torch.no_grad()
    def act(self, pixels: torch.Tensor, goal: torch.Tensor, step: int | None = None) -> torch.Tensor:
        """Return the chunk ``[B, size, A]`` (SI units) that begins at the step of a frame.

        Args:
            pixels: frames uint8 ``[B, 3, S, cameras * S]``.
            goal: goals ``[B, G]`` (SI units).
            step: number of the step before which the frames were taken, from 0. Step 0 begins a new episode, as does
                :meth:`reset`. By default, the whole last chunk has been executed since the last frame.

        Raises:
            ValueError: the step is before that of the last call, as of a frame that was overtaken, or the batch has
                another size.
        """
        step = max(self.steps, default=-1) + 1 if step is None else step
        if step == 0:
            self.reset()
        if step < self.first:
            raise ValueError(
                f"step must not be before {self.first}, the step of the last call, got {step}; leave out frames that "
                "were overtaken, or call reset for a new episode"
            )
        if any(len(td) != len(goal) for td in self.steps.values()):
            raise ValueError(
                f"goal must have the batch of the last call, got {len(goal)}; call reset for another"
            )
        # Where a robot has waited for a chunk, its step may lie beyond the last chunk.
        before = min(step - 1, max(self.steps, default=-1))
        chunk = {step - 1: self.steps[before]} if before in self.steps else {}
        td = self._after(chunk.get(step - 1), goal).set(self.actor.pixels, pixels)
        for t in range(step, step + self.size):
            td = self.actor.observe(td)
            if t < step + self.delay and t in self.steps:
                td.update(self.steps[t].select(*self.actor.latent_actor.out_keys))
            else:
                td = self.actor.act(td)
            chunk[t] = self.actor.predict(td)
            td = self._after(chunk[t], goal)
        self.steps, self.first = chunk, step
        return torch.stack([chunk[t][self.actor.action] for t in range(step, step + self.size)], 1)

    def _after(self, td: TensorDict | None, goal: torch.Tensor) -> TensorDict:
        """Return the memories after a step, empty before the first, and the goal."""
        td = TensorDict({}, goal.shape[:1], device=goal.device) if td is None else td["next"].copy()
        return td.set(self.actor.latent_actor.goal, goal)
