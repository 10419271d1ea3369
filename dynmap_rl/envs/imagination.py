"""The world model as a TorchRL environment: policies act in what it predicts, with no simulator (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from .world_model_transform import WorldModelTransform
from dynmap_rl.modules.actor import MEMORY
from dynmap_rl.modules.world_model import WorldModel

STEP_KEYS = ("latent", "predicted_latent", *MEMORY)


class ImaginationEnv(ModelBasedEnvBase):
    """A world model in open loop: the latent that it predicts is the next latent, and no frame is ever seen.

    Every reset begins at ``start``; ``env.reset(other, set_state=True)`` begins once at another TensorDict of the
    same keys. :func:`make_start` makes one from frames. Any TorchRL policy that reads ``latent``, ``hidden1``,
    ``hidden2`` and ``goal`` acts in it, for example :class:`dynmap_rl.modules.LatentActor`. Gradients flow through the
    steps unless they are switched off.

    Action: float32 ``[B, 3]``, dX, dY, dTheta (m, m, rad), within the limits of the simulated cart's speed.

    Observations ``[B, ...]``: ``latent``, ``predicted_latent`` (equal but at the start), ``hidden1``, ``cell1``,
    ``hidden2``, ``cell2``; ``("predicted_dynamics", quantity)`` (SI units) for what the world model decodes;
    ``("reconstruction", "pixels")`` float32 in 0..1, with ``decode_pixels``; and what else ``start`` holds, such as
    ``goal``, which stays as it is. Nothing is predicted for the first frame of an episode: where that is the start,
    its dynamics and frame are decoded from zeros. Under other names, nested ones too, by TorchRL's ``RenameTransform``
    (what is also read, such as ``latent``, in both directions).

    The world model predicts no task reward and no end of an episode: ``reward`` is what the function given for it
    makes of the observations, 0 without one, and ``done`` is never true. Give ``env.rollout`` a number of steps.

    Args:
        world_model: what predicts.
        start: ``[B]`` with ``latent`` ``[B, Z]`` and, or else zeros, ``predicted_latent`` ``[B, Z]`` and the memory,
            four times ``[B, H]``.
        decode_pixels: decode a frame a step.
        reward: a function of the observations after a step, a TensorDict ``[B]``, to float32 ``[B, 1]``: minus the
            distance of ``("predicted_dynamics", "position")`` to ``goal``, say.

    Raises:
        ValueError: ``start`` has not one batch axis, or no latents of the world model's size.
    """

    batch_locked = True
    _supports_set_state = True

    def __init__(
        self,
        world_model: WorldModel,
        start: TensorDictBase,
        decode_pixels: bool = False,
        reward: Callable[[TensorDictBase], torch.Tensor] | None = None,
    ):
        size = world_model.latent_size
        if start.ndim != 1 or start.get("latent", torch.empty(0)).shape != (*start.shape, size):
            raise ValueError(f"start must be a TensorDict [B] with latent [B, {size}], got {start}")
        device = start["latent"].device
        super().__init__(world_model, device=device, batch_size=start.batch_size)
        self.decode_pixels, self.reward_function = decode_pixels, reward
        keys = [key for key in start.keys(True, True) if key not in STEP_KEYS]
        self.constant = [key for key in keys if key[0] not in ("predicted_dynamics", "reconstruction")]
        with torch.no_grad():
            self.start = self._complete(start)
        self._make_specs()

    def _complete(self, start: TensorDictBase) -> TensorDict:
        """All observations at the start."""
        td = TensorDict({}, self.batch_size, device=self.device).update(start.select(*self.constant))
        latent = start["latent"]
        values = (torch.zeros_like(latent), *self.world_model.initial_state(len(latent), latent.device))
        for key, zeros in zip(STEP_KEYS[1:], values, strict=True):
            td[key] = start.get(key, zeros)
        return self._decode(td.set("latent", latent))

    def _make_specs(self) -> None:
        shape, device = self.batch_size, self.device
        observation, state = Composite(shape=shape, device=device), Composite(shape=shape, device=device)
        for key, value in self.start.items(True, True):
            observation[key] = Unbounded(value.shape, dtype=value.dtype, device=device)
            if key in (*STEP_KEYS, *self.constant):
                state[key] = observation[key].clone()
        self.observation_spec, self.state_spec = observation, state
        action = self.world_model.transition.action
        low, high = (
            x.expand(*shape, -1).clone() for x in (action.center - action.scale, action.center + action.scale)
        )
        self.action_spec = Bounded(low, high, low.shape, dtype=torch.float32, device=device)
        self.reward_spec = Unbounded((*shape, 1), dtype=torch.float32, device=device)

    def _reset(
        self, tensordict: TensorDictBase | None = None, set_state: bool = False, **kwargs
    ) -> TensorDict:
        if not set_state:
            return self.start.clone()
        with torch.no_grad():
            return self._complete(tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        memory = tuple(tensordict[key] for key in MEMORY)
        latent, memory = self.world_model.step(tensordict["latent"], tensordict["action"], memory)
        td = TensorDict({}, self.batch_size, device=self.device).update(tensordict.select(*self.constant))
        for key, value in zip(STEP_KEYS, (latent, latent, *memory), strict=True):
            td[key] = value
        td = self._decode(td)
        reward = latent.new_zeros(*self.batch_size, 1)
        return td.set("reward", reward if self.reward_function is None else self.reward_function(td))

    def _decode(self, td: TensorDict) -> TensorDict:
        states = td["predicted_latent"], td["hidden1"], td["hidden2"]
        for quantity, value in self.world_model.decode_dynamics(*states).items():
            td["predicted_dynamics", quantity] = value
        if self.decode_pixels:
            td["reconstruction", "pixels"] = self.world_model.decode_pixels(*states)
        return td

    def _set_seed(self, seed: int | None) -> None:
        """Nothing is drawn at random."""


def make_start(world_model: WorldModel, frames: TensorDictBase, mixed: bool = False) -> TensorDictBase:
    """Where imagination begins: what the world model makes of the first frames of episodes, at the last of them.

    Args:
        frames: ``[B, T]``, T >= 1, with ``pixels``, ``action`` (the last one is not used) and, optional, ``goal``.
        mixed: encode in the precision of training.

    Returns:
        ``[B]`` with ``latent``, ``predicted_latent``, the memory and the goal.
    """
    seen = WorldModelTransform(world_model, mixed=mixed)(
        frames.select("pixels", "action", "goal", strict=False)
    )
    return seen.exclude("pixels", "action")[:, -1]
