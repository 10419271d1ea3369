"""A frozen world model as a TorchRL transform, which adds the latents that policies read."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

from dynmap_rl.modules.actor import MEMORY
from dynmap_rl.modules.world_model import WorldModel


class WorldModelTransform(Transform):
    """Transform that adds latents and hidden states of a frozen world model to an environment with frames.

    At t it writes ``latent``, the encoded frame (paper, Sec. III), and ``predicted_latent``, ``hidden1``, ``cell1``,
    ``hidden2``, ``cell2``, the world model's prediction of t from all earlier frames and actions. The memory passes
    from step to step through the TensorDict: the transform itself has no state. The memory is zero in every world that
    is reset. Nothing has a gradient.

    In a replay buffer, or called on a TensorDict ``[B, T]``, the transform writes the same for whole windows. Memory
    is then zero at t = 0, also in a window from the middle of an episode, and wherever ``is_init`` ``[B, T, 1]`` is true.

    Args:
        world_model: world model that encodes and predicts.
        pixels: key of the frames ``[..., 3, S, cameras * S]``, which is read.
        action: key of the actions ``[..., A]`` (SI units), which is read.
        latent: key of the latent ``[..., Z]``, which is written.
        predicted_latent: key of the predicted latent ``[..., Z]``, which is written.
        memory: keys of the memory, four times ``[..., H]``, which are written and read back.
        is_init: key of the flag where an episode begins, read in windows only.
        agent_pos: if given, key of the commanded cart pose x, y, theta (its first A entries). The change of this
            entry takes the place of ``action``. It is the action that the cart executed within its limits, on which
            world models are trained, also in an environment whose actions are accelerations. Windows need the key
            under ``next``, too.
        mixed: encode in the precision of training (see :meth:`dynmap_rl.modules.WorldModel.encode`).

    Raises:
        ValueError: the environment has no uint8 frames, or a TensorDict outside of an environment no windows.
    """

    def __init__(
        self,
        world_model: WorldModel,
        pixels: NestedKey = "pixels",
        action: NestedKey = "action",
        latent: NestedKey = "latent",
        predicted_latent: NestedKey = "predicted_latent",
        memory: tuple[NestedKey, ...] = MEMORY,
        is_init: NestedKey = "is_init",
        agent_pos: NestedKey | None = None,
        mixed: bool = False,
    ):
        super().__init__(in_keys=[pixels], out_keys=[latent, predicted_latent, *memory])
        self.world_model, self.mixed = world_model, mixed
        self.action, self.is_init, self.agent_pos = action, is_init, agent_pos

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # TorchRL keeps the old entries of the worlds that are not reset, so these need no encoding.
        batch = tensordict_reset.batch_size
        mask = tensordict.get("_reset", torch.ones(batch, dtype=torch.bool)).reshape(batch)
        pixels = tensordict_reset.get(self.in_keys[0], None)
        if pixels is None or pixels.dtype != torch.uint8:
            raise ValueError(
                f"{self.in_keys[0]} must be uint8 frames [..., 3, S, cameras * S] of the environment: make it with "
                "from_pixels=True, and leave ToTensorImage out"
            )
        latent, *zeros = (torch.zeros(*batch, size, device=pixels.device) for size in self._sizes().values())
        latent[mask] = self.world_model.encode(pixels[mask], self.mixed)
        return self._write(tensordict_reset, latent, *zeros)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        latent, _, *memory = (tensordict[key] for key in self.out_keys)
        after = self.world_model.step(
            latent, self._executed_action(tensordict, next_tensordict), tuple(memory)
        )
        latent = self.world_model.encode(next_tensordict[self.in_keys[0]], self.mixed)
        return self._write(next_tensordict, latent, after[0], *after[1])

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.ndim != 2:
            shape = tuple(tensordict.shape)
            raise ValueError(f"outside of an environment the TensorDict must be windows [B, T], got {shape}")
        latent = self.world_model.encode(tensordict[self.in_keys[0]], self.mixed)  # (B, T, Z)
        action = self._executed_action(tensordict, tensordict.get("next", TensorDict()))
        begins = tensordict.get(self.is_init, None)
        states = (torch.zeros_like(latent[:, 0]), *self.world_model.initial_state(len(latent), latent.device))
        steps = []
        for t in range(latent.shape[1]):
            if begins is not None:
                states = tuple(x.masked_fill(begins[:, t], 0.0) for x in states)
            steps.append(states)
            predicted, memory = self.world_model.step(latent[:, t], action[:, t], states[1:])
            states = (predicted, *memory)
        return self._write(tensordict, latent, *(torch.stack(x, 1) for x in zip(*steps, strict=True)))

    def _executed_action(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> torch.Tensor:
        if self.agent_pos is None:
            return tensordict[self.action]
        change = next_tensordict[self.agent_pos] - tensordict[self.agent_pos]
        return change[..., : self.world_model.transition.action.size]

    def _sizes(self) -> dict[NestedKey, int]:
        sizes = dict.fromkeys(self.out_keys[2:], self.world_model.hidden_size)
        return dict.fromkeys(self.out_keys[:2], self.world_model.latent_size) | sizes

    def _write(self, tensordict: TensorDictBase, *values: torch.Tensor) -> TensorDictBase:
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key, size in self._sizes().items():
            observation_spec[key] = Unbounded((*observation_spec.shape, size), device=observation_spec.device)
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Add the entries that a step reads besides the action, so that worlds in other processes get them."""
        state_spec = input_spec["full_state_spec"]
        if state_spec is None:
            state_spec = Composite(shape=input_spec.shape, device=input_spec.device)
        state_spec = self.transform_observation_spec(state_spec)
        if self.agent_pos is not None:
            key = unravel_key(self.agent_pos)
            state_spec[key] = self.parent.full_observation_spec[key].clone()
        input_spec["full_state_spec"] = state_spec
        return input_spec
