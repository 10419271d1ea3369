"""World model and policies as TensorDict modules, with the keys of the project as defaults."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer

from .policy import FeedforwardPolicy, RecurrentPolicy
from .world_model import WorldModel

MEMORY = ("hidden1", "cell1", "hidden2", "cell2")
POLICY_MEMORY = tuple(f"policy_{key}" for key in MEMORY)
STATES = ("latent", "hidden1", "hidden2")
PREDICTED = ("predicted_latent", "hidden1", "hidden2")


def make_world_model_module(
    world_model: WorldModel,
    pixels: NestedKey = "pixels",
    action: NestedKey = "action",
    reconstruction: NestedKey = ("reconstruction", "pixels"),
    predicted_dynamics: NestedKey = "predicted_dynamics",
    latent: NestedKey = "latent",
    predicted: tuple[NestedKey, NestedKey, NestedKey] = PREDICTED,
) -> TensorDictSequential:
    """The sequence form: ``pixels``, ``action`` ``[B, T]`` to ``latent``, ``predicted_latent``, ``hidden1``,
    ``hidden2``, the reconstruction and ``(predicted_dynamics, quantity)``, all at their own time t.

    There is no prediction for t = 0: what stands there was decoded from zeros.

    Args:
        pixels, action: keys that are read.
        reconstruction, predicted_dynamics, latent: keys that are written.
        predicted: keys of predicted latent and the two hidden states, which are written.
    """
    predicted = list(predicted)
    modules = [
        TensorDictModule(world_model.encoder, [pixels], [latent]),
        TensorDictModule(world_model.transition, [latent, action], predicted),
        TensorDictModule(world_model.image_decoder, predicted, [reconstruction]),
    ]
    if world_model.supervision:
        keys = [unravel_key((predicted_dynamics, quantity)) for quantity in world_model.supervision]
        modules.append(TensorDictModule(world_model.dynamics_decoder, predicted, keys))
    return TensorDictSequential(*modules)


def make_policy_module(
    policy: FeedforwardPolicy | RecurrentPolicy,
    goal: NestedKey = "goal",
    action: NestedKey = "action",
    states: tuple[NestedKey, NestedKey, NestedKey] = STATES,
) -> TensorDictModule:
    """The sequence form of a policy: ``latent``, ``hidden1``, ``hidden2`` and ``goal`` ``[B, T]`` to ``action``.

    Args:
        states: keys of latent and the two hidden states.
    """
    return TensorDictModule(policy, [*states, goal], [action])


class LatentActor(TensorDictModuleBase):
    """A policy on latents and hidden states that are there already, one time step a call.

    For environments that give them: those with a :class:`dynmap_rl.envs.WorldModelTransform`, and
    :class:`dynmap_rl.envs.ImaginationEnv`. Reads ``latent``, ``hidden1``, ``hidden2``, ``goal`` and the policy's own
    memory at t, writes ``action`` at t and, under ``next``, the memory at t + 1. Memory is zero where it is absent
    and where ``is_init`` (optional, ``[..., 1]``) says that an episode begins.

    In ``env.rollout`` or a collector, append :meth:`make_tensordict_primer` and ``InitTracker`` to the environment,
    where the policy is recurrent.

    Args:
        policy: what acts.
        states: keys of latent and the two hidden states.
        goal, action, is_init: keys.
        policy_memory: keys of a recurrent policy's memory.
    """

    def __init__(
        self,
        policy: FeedforwardPolicy | RecurrentPolicy,
        states: tuple[NestedKey, NestedKey, NestedKey] = STATES,
        goal: NestedKey = "goal",
        action: NestedKey = "action",
        is_init: NestedKey = "is_init",
        policy_memory: tuple[NestedKey, ...] = POLICY_MEMORY,
    ):
        super().__init__()
        self.policy, self.states, self.goal, self.action, self.is_init = policy, states, goal, action, is_init
        self.policy_memory = tuple(policy_memory) if isinstance(policy, RecurrentPolicy) else ()
        self.in_keys = [unravel_key(k) for k in (*states, goal, is_init, *self.policy_memory)]
        self.out_keys = [unravel_key(action), *(unravel_key(("next", k)) for k in self.policy_memory)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self.act(tensordict, *(tensordict[key] for key in self.states))

    def act(self, tensordict: TensorDictBase, latent, hidden1, hidden2) -> TensorDictBase:
        """The same, for states that are not in the TensorDict."""
        state = None
        if self.policy_memory:
            sizes = dict.fromkeys(self.policy_memory, self.policy.lstm.hidden_size)
            state = _recall(tensordict, sizes, self.is_init, latent.device)
        action, state = self.policy.step(latent, hidden1, hidden2, tensordict[self.goal], state)
        tensordict.set(self.action, action)
        _remember(tensordict, self.policy_memory, state or ())
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an environment the policy's memory, zero at every reset."""
        size = self.policy.lstm.hidden_size if self.policy_memory else 0
        return _make_primer(dict.fromkeys(self.policy_memory, size))


class Actor(TensorDictModuleBase):
    """World model and policy as one recurrent TensorDict policy, one time step a call.

    Reads ``pixels`` ``[..., 3, 64, 64]``, ``goal`` ``[..., G]`` and the memories at t, writes ``action`` ``[..., A]``
    and ``latent`` at t and, under ``next``, the memories and ``predicted_latent`` at t + 1. Memories are zero where
    they are absent and where ``is_init`` (optional, ``[..., 1]``) says that an episode begins.

    In ``env.rollout`` or a collector, append :meth:`make_tensordict_primer` and ``InitTracker`` to the environment.

    Args:
        world_model, policy: what acts.
        pixels, goal, action, is_init: keys.
        mixed: encode frames in the precision of training (see :meth:`WorldModel.encode`), as recipes do.
        latent, predicted_latent: keys that are written.
        memory, policy_memory: keys of the world model's memory and of a recurrent policy's, four each.
    """

    def __init__(
        self,
        world_model: WorldModel,
        policy: FeedforwardPolicy | RecurrentPolicy,
        pixels: NestedKey = "pixels",
        goal: NestedKey = "goal",
        action: NestedKey = "action",
        is_init: NestedKey = "is_init",
        mixed: bool = False,
        latent: NestedKey = "latent",
        predicted_latent: NestedKey = "predicted_latent",
        memory: tuple[NestedKey, ...] = MEMORY,
        policy_memory: tuple[NestedKey, ...] = POLICY_MEMORY,
    ):
        super().__init__()
        states = (latent, memory[0], memory[2])
        self.world_model, self.mixed = world_model, mixed
        self.latent_actor = LatentActor(policy, states, goal, action, is_init, policy_memory)
        self.pixels, self.action, self.is_init = pixels, action, is_init
        self.latent, self.predicted_latent, self.memory = latent, predicted_latent, tuple(memory)
        read = [pixels, goal, is_init, *self.memory, *self.latent_actor.policy_memory]
        self.in_keys = [unravel_key(key) for key in read]
        after = [unravel_key(("next", key)) for key in (predicted_latent, *self.memory)]
        self.out_keys = [*self.latent_actor.out_keys, unravel_key(latent), *after]

    @property
    def policy(self) -> FeedforwardPolicy | RecurrentPolicy:
        """The policy without its TensorDict adapter."""
        return self.latent_actor.policy

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        pixels = tensordict[self.pixels]
        sizes = dict.fromkeys(self.memory, self.world_model.hidden_size)
        state = _recall(tensordict, sizes, self.is_init, pixels.device)
        latent = self.world_model.encode(pixels, self.mixed)
        tensordict.set(self.latent, latent)
        self.latent_actor.act(tensordict, latent, state[0], state[2])
        predicted, state = self.world_model.step(latent, tensordict[self.action], state)
        _remember(tensordict, (self.predicted_latent, *self.memory), (predicted, *state))
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an environment the memories, zero at every reset."""
        sizes = dict.fromkeys(self.memory, self.world_model.hidden_size)
        if self.latent_actor.policy_memory:
            sizes |= dict.fromkeys(self.latent_actor.policy_memory, self.policy.lstm.hidden_size)
        return _make_primer(sizes)


def _recall(tensordict: TensorDictBase, sizes: dict, is_init: NestedKey, device) -> tuple[torch.Tensor, ...]:
    """The entries of ``sizes``; zeros where they are absent and where an episode begins."""
    batch = tensordict.batch_size
    state = tuple(tensordict.get(k, torch.zeros(*batch, n, device=device)) for k, n in sizes.items())
    begins = tensordict.get(is_init, None)
    return state if begins is None else tuple(s.masked_fill(begins, 0.0) for s in state)


def _remember(tensordict: TensorDictBase, keys, values) -> None:
    for key, value in zip(keys, values, strict=True):
        tensordict.set(unravel_key(("next", key)), value)


def _make_primer(sizes: dict) -> TensorDictPrimer:
    specs = Composite()
    for key, size in sizes.items():
        specs[key] = Unbounded((size,))
    return TensorDictPrimer(specs, default_value=0.0, expand_specs=True)
