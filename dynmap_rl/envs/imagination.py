"""The world model as a TorchRL environment without a simulator (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ModelBasedEnvBase

from dynmap_rl.modules.actor import MEMORY
from dynmap_rl.modules.world_model import WorldModel

from .world_model_transform import WorldModelTransform

STEP_KEYS = ("latent", "predicted_latent", *MEMORY)
# Entries of a rollout that are not observations.
OTHERS = "action", "next", "reward", "done", "terminated", "truncated", "is_init"


class ImaginationEnv(ModelBasedEnvBase):
    """World model in open loop: the predicted latent is the next latent, and no frame is encoded.

    Every reset begins at ``start``. ``env.reset(other, set_state=True)`` begins once at another TensorDict with the
    same keys. :func:`make_start` makes such a TensorDict from frames. Any TorchRL policy that reads ``latent``,
    ``hidden1``, ``hidden2`` and ``goal`` can act in this environment, for example
    :class:`dynmap_rl.modules.LatentActor`, but not :class:`dynmap_rl.modules.Actor`, which encodes frames. Steps are differentiable.

    Action: ``action`` float32 ``[B, A]``, in the range of the world model's own actions: dX, dY, dTheta (m, m, rad)
    within the limits of the simulated cart.

    Observation ``[B, ...]``: ``latent``, ``predicted_latent`` (equal except at the start), ``hidden1``, ``cell1``,
    ``hidden2``, ``cell2``; ``("predicted_dynamics", quantity)`` (SI units) for each quantity that the world model
    decodes; with ``decode_pixels`` ``("reconstruction", "pixels")``, float32 in about 0..1, not clipped; and all
    other entries of ``start``, such as ``goal``: unchanged, or as the policy writes them for the next step, such as its
    memory. There is no prediction of the first frame of an episode: at such a start
    dynamics and frame are decoded from zeros. TorchRL's ``RenameTransform`` gives the keys other names.

    Reward and end: a world model predicts no reward and no end of an episode. ``reward`` is the value of the given
    function, or 0 without one. ``done`` is always false, so ``env.rollout`` needs a number of steps.

    Args:
        world_model: world model that predicts.
        start: TensorDict ``[B]`` with ``latent`` ``[B, Z]``, and optionally ``predicted_latent`` ``[B, Z]`` and the
            memory, four times ``[B, H]`` (default: zeros). A step of a rollout may be given as it is.
        decode_pixels: decode a frame in each step.
        reward: function from the observations after a step, a TensorDict ``[B]``, to a reward ``[B, 1]``.

    Raises:
        ValueError: ``start`` has more or less than one batch axis, or no latents of the world model's size.
        TypeError: ``reward`` is no function.
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
        _check_start(start, world_model.latent_size)
        if not (reward is None or callable(reward)):
            raise TypeError(f"reward must be a function or None, got {reward!r}")
        device = next(world_model.parameters()).device  # to which the world model would be moved
        super().__init__(world_model, device=device, batch_size=start.batch_size)
        self.decode_pixels, self.reward_function = decode_pixels, reward
        start = start.exclude(*OTHERS).to(device)
        keys = [key for key in start.keys(True, True) if key not in STEP_KEYS]
        self.constant = [key for key in keys if key[0] not in ("predicted_dynamics", "reconstruction")]
        with torch.no_grad():
            self.start = self._complete(start)
        self._make_specs()

    def _complete(self, start: TensorDictBase) -> TensorDict:
        """Return all observations at a start."""
        start = start.clone()  # the caller may write to its tensors
        td = TensorDict({}, self.batch_size, device=self.device).update(start.select(*self.constant))
        latent = start["latent"]
        values = (torch.zeros_like(latent), *self.world_model.initial_state(len(latent), latent.device))
        for key, zeros in zip(STEP_KEYS[1:], values, strict=True):
            td[key] = start.get(key, zeros)
        return self._decode(td.set("latent", latent))

    def _input_td_has_state(self, tensordict: TensorDictBase | None) -> bool:
        return False  # before version 0.15, TorchRL takes any step of a rollout for a state to begin at

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
        _check_start(tensordict, self.world_model.latent_size)
        with torch.no_grad():
            return self._complete(tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        memory = tuple(tensordict[key] for key in MEMORY)
        latent, memory = self.world_model.step(tensordict["latent"], tensordict["action"], memory)
        td = TensorDict({}, self.batch_size, device=self.device).update(tensordict.select(*self.constant))
        if "next" in tensordict.keys():  # what a policy has written, such as its memory
            td.update(tensordict["next"].select(*self.constant, strict=False))
        # Without those that TorchRL holds, such as those that have ended in a chunk of actions.
        mask = tensordict.get("_step", torch.ones(self.batch_size, dtype=torch.bool, device=self.device))
        mask = mask.reshape(-1, 1)
        for key, value in zip(STEP_KEYS, (latent, latent, *memory), strict=True):
            td[key] = torch.where(mask, value, tensordict[key])
        td = self._decode(td)
        reward = latent.new_zeros(*self.batch_size, 1)
        if self.reward_function is not None:
            value = torch.as_tensor(self.reward_function(td))
            if value.shape != reward.shape:
                raise ValueError(f"reward must return {list(reward.shape)}, got {list(value.shape)}")
            reward = torch.where(mask, value.to(reward), reward)
        return td.set("reward", reward)

    def _decode(self, td: TensorDict) -> TensorDict:
        states = td["predicted_latent"], td["hidden1"], td["hidden2"]
        for quantity, value in self.world_model.decode_dynamics(*states).items():
            td["predicted_dynamics", quantity] = value
        if self.decode_pixels:
            td["reconstruction", "pixels"] = self.world_model.decode_pixels(*states)
        return td

    def to(self, device):
        """Move world model, start and specs."""
        super().to(device)
        self.start = self.start.to(self.device)
        return self

    def _set_seed(self, seed: int | None) -> None:
        """Do nothing, as nothing is random."""


def _check_start(start: TensorDictBase | None, size: int) -> None:
    latent = None if start is None else start.get("latent", None)
    if latent is None or start.ndim != 1 or latent.shape != (*start.shape, size):
        found = None if latent is None else tuple(latent.shape)
        raise ValueError(f"start must be a TensorDict [B] with latent [B, {size}], got latent {found}")


def make_start(
    world_model: WorldModel, frames: TensorDictBase, agent_pos: NestedKey | None = None
) -> TensorDictBase:
    """Make a start of :class:`ImaginationEnv` from the first frames of episodes, at the last of these frames.

    Args:
        world_model: world model that encodes the frames.
        frames: ``[B, T]``, T >= 1, with ``pixels``, ``action`` (the last one is not used) and optionally ``goal``. World
            models read executed actions, as datasets have them; in a rollout, ``action`` is the requested action.
        agent_pos: for rollouts, key of the commanded cart pose, whose changes are the executed actions (see
            :class:`WorldModelTransform`).

    Returns:
        TensorDict ``[B]`` with ``latent``, ``predicted_latent``, the memory and the goal.
    """
    poses = [agent_pos, unravel_key(("next", agent_pos))] if agent_pos else []
    frames = frames.select("pixels", "action", "goal", *poses, strict=False)
    transform = WorldModelTransform(world_model, agent_pos=agent_pos)
    return transform(frames).exclude("pixels", "action", "next", *poses)[:, -1]
