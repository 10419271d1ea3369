"""World model and policy as TensorDict modules, one time step a call, and their sequence forms."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torchrl.envs import TensorDictPrimer

from .memory import find, make_primer, recall, remember, warn_without_memory
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
    """Make the sequence form of a world model, from ``[B, T]`` to ``[B, T]``.

    It reads ``pixels`` and ``action`` and writes ``latent``, ``predicted_latent``, ``hidden1``, ``hidden2``, the
    reconstruction and ``(predicted_dynamics, quantity)``, each at its own time t. There is no prediction for t = 0:
    reconstruction and dynamics are decoded from zeros there.

    Args:
        world_model: encoder, transition and decoders.
        pixels: key that is read.
        action: key that is read.
        reconstruction: key that is written.
        predicted_dynamics: prefix of the keys that are written.
        latent: key that is written.
        predicted: keys of the predicted latent and of the two hidden states, which are written.
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
    """Make the sequence form of a policy: ``latent``, ``hidden1``, ``hidden2``, ``goal`` ``[B, T]`` to ``action``.

    Args:
        policy: feed-forward or recurrent.
        goal: key that is read.
        action: key that is written.
        states: keys of the latent and of the two hidden states, which are read.
    """
    return TensorDictModule(policy, [*states, goal], [action])


class LatentActor(TensorDictModuleBase):
    """Policy that acts on latents and hidden states, one time step a call.

    For environments that provide these states: those with a :class:`dynmap_rl.envs.WorldModelTransform`, and
    :class:`dynmap_rl.envs.ImaginationEnv`. It reads ``latent``, ``hidden1``, ``hidden2``, ``goal`` and the policy's own
    memory at t; it writes ``action`` at t and, under ``next``, the memory at t + 1. The memory is zero where it is
    absent and where ``is_init`` (optional, ``[..., 1]``) is true.

    In ``env.rollout`` or a collector, a recurrent policy needs :meth:`make_tensordict_primer` and ``InitTracker`` as
    transforms of the environment.

    Args:
        policy: recurrent, feed-forward, or any other module from ``latent``, ``hidden1``, ``hidden2`` and ``goal`` to
            actions ``[..., A]``.
        states: keys of the latent and of the two hidden states.
        goal: key that is read.
        action: key that is written.
        is_init: key that is read.
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
        self.blind = False
        self.in_keys = [unravel_key(k) for k in (*states, goal, is_init, *self.policy_memory)]
        self.out_keys = [unravel_key(action), *(unravel_key(("next", k)) for k in self.policy_memory)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next memory."""
        warn_without_memory(self, tensordict, self.policy_memory)
        return self.act(tensordict, *(tensordict[key] for key in self.states))

    def act(self, tensordict: TensorDictBase, latent, hidden1, hidden2) -> TensorDictBase:
        """Act on states ``[..., Z]`` and ``[..., H]`` that are not in the TensorDict.

        Raises:
            TypeError: the policy returns more than actions and is no :class:`RecurrentPolicy`.
        """
        state, keys = None, self.policy_memory
        if keys:
            sizes = dict.fromkeys(keys, self.policy.lstm.hidden_size)
            state = recall(tensordict, sizes, self.is_init, latent.device)
        inputs = latent, hidden1, hidden2, tensordict[self.goal]
        action, state = self.policy.step(*inputs, state) if keys else (self.policy(*inputs), None)
        if not isinstance(action, torch.Tensor):
            raise TypeError(
                "policy must return actions [..., A] alone, or be a RecurrentPolicy where it has a memory, got "
                f"{type(action).__name__} of {type(self.policy).__name__}"
            )
        tensordict.set(self.action, action)
        remember(tensordict, keys, state or ())
        return tensordict

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that gives an environment the policy's memory, zero at every reset."""
        size = self.policy.lstm.hidden_size if self.policy_memory else 0
        return make_primer(dict.fromkeys(self.policy_memory, size))


class Actor(TensorDictModuleBase):
    """World model and policy as one recurrent TensorDict policy, one time step a call.

    A call is three steps, which can also be called one by one, for example to execute another action than the
    policy's: :meth:`observe` writes ``latent`` from ``pixels``; :meth:`act` writes ``action`` and the policy's next
    memory; :meth:`predict` writes ``predicted_latent`` and the world model's next memory from ``action``. Where the
    TensorDict has no ``pixels``, the predicted latent takes the frame's place: the actor imagines.

    It reads ``pixels`` ``[..., 3, S, cameras * S]``, ``goal`` ``[..., G]`` and the memories at t; it writes ``action``
    ``[..., A]`` and ``latent`` at t and, under ``next``, the memories and ``predicted_latent`` at t + 1. Memories are
    zero where they are absent and where ``is_init`` (optional, ``[..., 1]``) is true.

    In ``env.rollout`` or a collector, append :meth:`make_tensordict_primer` and ``InitTracker`` to the environment.

    Behind the actor, a module that changes the action, such as TorchRL's exploration noise, comes too late for the
    memory. Put it between :meth:`act` and :meth:`predict`, or use :class:`dynmap_rl.envs.WorldModelTransform` and
    :class:`LatentActor`.

    Args:
        world_model: encoder and transition.
        policy: see :class:`LatentActor`.
        pixels: key that is read.
        goal: key that is read.
        action: key that is written.
        is_init: key that is read.
        mixed: encode frames in the precision of training (see :meth:`WorldModel.encode`), as recipes do.
        latent: key that is written.
        predicted_latent: key that is written and, in imagination, read.
        memory: four keys of the world model's memory.
        policy_memory: four keys of a recurrent policy's memory.
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
        states, self.blind = (latent, memory[0], memory[2]), False
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
        """Observe, act and predict."""
        warn_without_memory(self, tensordict, (*self.memory, *self.latent_actor.policy_memory))
        return self.predict(self.act(self.observe(tensordict)))

    def observe(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``latent``: the encoded frame or, without a frame, the predicted latent.

        Raises:
            KeyError: there is neither a frame nor a predicted latent, or an episode begins without a frame.
        """
        pixels = find(tensordict, self.pixels)
        if pixels is None:
            predicted, begins = (find(tensordict, key) for key in (self.predicted_latent, self.is_init))
            begun = begins is None or torch.compiler.is_compiling() or not begins.any()
            check_frame(self.pixels, predicted is not None and begun)
            return tensordict.set(self.latent, predicted)
        return tensordict.set(self.latent, self.world_model.encode(pixels, self.mixed))

    def act(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the policy's ``action`` and its next memory."""
        latent, state = tensordict[self.latent], self._recall(tensordict)
        return self.latent_actor.act(tensordict, latent, state[0], state[2])

    def predict(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the predicted latent and the world model's memory of the next step, from ``latent`` and ``action``."""
        state = self._recall(tensordict)
        predicted, state = self.world_model.step(tensordict[self.latent], tensordict[self.action], state)
        remember(tensordict, (self.predicted_latent, *self.memory), (predicted, *state))
        return tensordict

    def _recall(self, tensordict: TensorDictBase) -> tuple[torch.Tensor, ...]:
        sizes = dict.fromkeys(self.memory, self.world_model.hidden_size)
        return recall(tensordict, sizes, self.is_init, tensordict[self.latent].device)

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that gives an environment the memories, zero at every reset."""
        sizes = dict.fromkeys(self.memory, self.world_model.hidden_size)
        if self.latent_actor.policy_memory:
            sizes |= dict.fromkeys(self.latent_actor.policy_memory, self.policy.lstm.hidden_size)
        return make_primer(sizes)


def check_frame(pixels: NestedKey, predicted: bool) -> None:
    """Raise ``KeyError`` where there is no predicted latent in the place of a frame."""
    if not predicted:
        raise KeyError(
            f"there is no frame {pixels!r} and no latent that was predicted before it; an episode must begin with a frame of "
            "its first step, and environments of this package need from_pixels=True"
        )
