"""World model and policy on frames that arrive late: the world model imagines the steps up to the present."""

from __future__ import annotations

from numbers import Integral

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer

from .actor import MEMORY, Actor, check_frame
from .memory import check_memory, find, remember, warn_without_memory
from .world_model import WorldModel

BASE = ("predicted_latent", *MEMORY)  # state of the world model before the oldest step that is remembered


class DelayedActor(TensorDictModuleBase):
    """Actor whose frames arrive late, out of order, several at a time, or never.

    The actor remembers the last ``max_delay`` steps: the latents of the frames that have arrived, and the actions. In
    every call, the world model reads these steps again, each frame together with the action that followed it. Where a
    frame is missing, the predicted latent takes its place, as in :class:`dynmap_rl.envs.ImaginationEnv`. This gives
    latent and hidden states of the present, and the policy acts on them. The policy's own memory goes on from step to
    step, and is never repeated. Without delay, the actions are exactly those of :class:`Actor`.

    In addition to the entries of ``actor``, it reads ``history``, a TensorDict, at t and writes it under ``next``. The world
    model's memory is only written: it is the estimate of the present. It also reads ``delay`` int64
    ``[..., 1]``: the number of steps since the frame in ``pixels`` was taken. Several frames that arrive in the same
    step have one more axis, ``pixels`` ``[..., M, 3, S, cameras * S]`` and ``delay`` ``[..., M]``, in any order. A negative delay
    marks a place without a frame, and frames from before the episode are not used. Of several frames of one step, the last
    is used. :class:`dynmap_rl.envs.DelayTransform` writes both entries. Without ``delay`` in the TensorDict, every frame is
    as old as the argument ``delay``, or the first one of the episode. Without ``pixels``, no frame has arrived. An episode
    must begin with a frame without delay, as a robot waits for it before it moves.

    A call is :meth:`observe`, :meth:`act` and :meth:`predict`, as that of :class:`Actor`. In ``env.rollout`` or a
    collector, append :meth:`make_tensordict_primer` and ``InitTracker`` to the environment.

    Args:
        actor: world model and policy, with the names of their keys.
        delay: delay of all frames in steps, where the TensorDict has no entry ``delay``.
        max_delay: longest delay in steps; older frames are not used. Default: ``delay``. A call takes ``max_delay + 2``
            steps of the world model.
        delay_key: key of the delays, which is read.
        history: key of the remembered steps, which is read and written.

    Raises:
        ValueError: ``delay`` is negative, above ``max_delay`` or not whole; or, in a call, there is not one delay for
            each frame.
        KeyError: an episode begins without a frame of its first step.
    """

    def __init__(
        self,
        actor: Actor,
        delay: int = 0,
        max_delay: int | None = None,
        delay_key: NestedKey = "delay",
        history: NestedKey = "history",
    ):
        super().__init__()
        max_delay = delay if max_delay is None else max_delay
        if not all(isinstance(steps, Integral) for steps in (delay, max_delay)):
            raise ValueError(f"delay and max_delay must be whole steps, got {delay} and {max_delay}")
        if not 0 <= delay <= max_delay:
            raise ValueError(f"delay must be between 0 and max_delay, got {delay} and {max_delay}")
        self.actor, self.delay, self.max_delay = actor, delay, max_delay
        self.is_init, self.blind = actor.is_init, False
        self.delay_key, self.history = unravel_key(delay_key), unravel_key(history)
        memory = [unravel_key(key) for key in actor.memory]
        entries = [unravel_key((history, name)) for name in self._sizes()]
        self.in_keys = [key for key in actor.in_keys if key not in memory] + [self.delay_key, *entries]
        after = [unravel_key(("next", key)) for key in entries]
        self.out_keys = [*actor.out_keys, *memory, *entries, *after]

    @property
    def world_model(self) -> WorldModel:
        """The actor's world model."""
        return self.actor.world_model

    def _sizes(self) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Return shape and dtype of the entries of a history. The last of its steps is the present."""
        model, steps = self.world_model, self.max_delay + 1
        shapes = {
            "latent": (steps, model.latent_size),
            "action": (steps, model.transition.action.size),
            "predicted_latent": (model.latent_size,),
            **dict.fromkeys(MEMORY, (model.hidden_size,)),
        }
        sizes = {name: (shape, torch.float32) for name, shape in shapes.items()}
        return sizes | {"arrived": ((steps, 1), torch.bool), "step": ((1,), torch.int64)}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Observe, act and predict."""
        warn_without_memory(self, tensordict, [self.history])
        return self.predict(self.act(self.observe(tensordict)))

    def observe(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``latent`` and the world model's memory of the present, from the history and the frames that arrive."""
        history = self._recall(tensordict)
        self._receive(tensordict, history)
        states = tuple(history[name] for name in BASE)
        for i in range(self.max_delay):
            states = self._advance(history, i, states)
        tensordict.set(self.history, history)
        tensordict.set(self.actor.latent, _choose(history, -1, states[0]))
        for key, value in zip(self.actor.memory, states[1:], strict=True):
            tensordict.set(key, value)
        return tensordict

    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's ``action`` and its next memory."""
        latent_actor = self.actor.latent_actor
        return latent_actor.act(tensordict, *(tensordict[key] for key in latent_actor.states))

    def predict(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next history, predicted latent and memory of the world model, from ``action``."""
        history = tensordict[self.history].clone()
        action = tensordict[self.actor.action]
        history["action"][..., -1, :] = action
        memory = tuple(tensordict[key] for key in self.actor.memory)
        predicted, memory = self.world_model.step(tensordict[self.actor.latent], action, memory)
        remember(tensordict, (self.actor.predicted_latent, *self.actor.memory), (predicted, *memory))
        base = self._advance(history, 0, tuple(history[name] for name in BASE))
        history.update(dict(zip(BASE, base, strict=True)))
        for name in ("latent", "action", "arrived"):
            steps = history[name]
            history[name] = torch.cat([steps[..., 1:, :], torch.zeros_like(steps[..., :1, :])], -2)
        tensordict.set(unravel_key(("next", self.history)), history.set("step", history["step"] + 1))
        return tensordict

    def _recall(self, tensordict: TensorDictBase) -> TensorDict:
        """Return a copy of the history, which is empty where it is absent and where an episode begins."""
        history, begins = find(tensordict, self.history), find(tensordict, self.actor.is_init)
        check_memory(tensordict, [self.history], begins)
        if history is None:
            batch, device = tensordict.batch_size, next(self.parameters()).device
            zeros = {
                n: torch.zeros(*batch, *s, dtype=d, device=device) for n, (s, d) in self._sizes().items()
            }
            return TensorDict(zeros, batch)
        return history.clone() if begins is None else history.masked_fill(begins.squeeze(-1), 0)

    def _receive(self, tensordict: TensorDictBase, history: TensorDict) -> None:
        """Encode the frames that arrive and put each where it belongs."""
        pixels, step = find(tensordict, self.actor.pixels), history["step"]
        if pixels is not None:
            self._place(tensordict, history, pixels)
        if not torch.compiler.is_compiling():
            check_frame(self.actor.pixels, bool((history["arrived"][..., -1, :] | (step > 0)).all()))

    def _place(self, tensordict: TensorDictBase, history: TensorDict, pixels: torch.Tensor) -> None:
        step, delay = history["step"], find(tensordict, self.delay_key)
        delay = step.clamp(max=self.delay) if delay is None else delay
        if pixels.ndim == tensordict.ndim + 3:
            pixels = pixels.unsqueeze(-4)  # (..., M, 3, 64, 64) with M = 1
        if delay.shape != pixels.shape[:-3] or delay.is_floating_point():
            raise ValueError(
                f"{self.delay_key} must be int64 {list(pixels.shape[:-3])}, a delay for each frame, "
                f"got {delay.dtype} {list(delay.shape)}"
            )
        later = (delay[..., :, None] == delay[..., None, :]).triu(1).any(-1)  # frames of the same step
        used = ((delay >= 0) & (delay <= step.clamp(max=self.max_delay)) & ~later).nonzero(as_tuple=True)
        if used[0].numel():
            place = (*used[:-1], self.max_delay - delay[used])
            history["latent"][place] = self.world_model.encode(pixels[used], self.actor.mixed)
            history["arrived"][place] = True

    def _advance(self, history: TensorDict, i: int, states: tuple) -> tuple[torch.Tensor, ...]:
        """Return predicted latent and memory after the step ``i`` of the history; unchanged before the episode."""
        latent = _choose(history, i, states[0])
        predicted, memory = self.world_model.step(latent, history["action"][..., i, :], states[1:])
        begun = history["step"] >= self.max_delay - i
        return tuple(torch.where(begun, *pair) for pair in zip((predicted, *memory), states, strict=True))

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that gives an environment history and policy memory, empty at every reset."""
        specs = self.actor.latent_actor.make_tensordict_primer().primers
        sizes = self._sizes().items()
        specs[self.history] = Composite({name: Unbounded(shape, dtype=kind) for name, (shape, kind) in sizes})
        return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)


def _choose(history: TensorDict, i: int, predicted: torch.Tensor) -> torch.Tensor:
    """Return the latent of the step ``i`` of the history; the predicted one without a frame."""
    return torch.where(history["arrived"][..., i, :], history["latent"][..., i, :], predicted)
