"""World model and policies as TensorDict modules, with the keys of the project as defaults."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torchrl.data import Composite, Unbounded
from torchrl.envs import TensorDictPrimer

from .policy import FeedforwardPolicy, RecurrentPolicy
from .world_model import WorldModel

MEMORY = ("hidden1", "cell1", "hidden2", "cell2")
STATES = ("latent", "hidden1", "hidden2")


def make_world_model_module(
    world_model: WorldModel,
    pixels: NestedKey = "pixels",
    action: NestedKey = "action",
    reconstruction: NestedKey = ("reconstruction", "pixels"),
    predicted_dynamics: NestedKey = "predicted_dynamics",
) -> TensorDictSequential:
    """The sequence form: ``pixels``, ``action`` ``[B, T]`` to ``latent``, ``predicted_latent``, ``hidden1``,
    ``hidden2``, the reconstruction and ``(predicted_dynamics, quantity)``, all at their own time t.

    There is no prediction for t = 0: what stands there was decoded from zeros.
    """
    nested = (predicted_dynamics,) if isinstance(predicted_dynamics, str) else predicted_dynamics
    predicted = ["predicted_latent", "hidden1", "hidden2"]
    modules = [
        TensorDictModule(world_model.encoder, [pixels], ["latent"]),
        TensorDictModule(world_model.transition, ["latent", action], predicted),
        TensorDictModule(world_model.image_decoder, predicted, [reconstruction]),
    ]
    if world_model.supervision:
        keys = [(*nested, quantity) for quantity in world_model.supervision]
        modules.append(TensorDictModule(world_model.dynamics_decoder, predicted, keys))
    return TensorDictSequential(*modules)


def make_policy_module(
    policy: FeedforwardPolicy | RecurrentPolicy, goal: NestedKey = "goal", action: NestedKey = "action"
) -> TensorDictModule:
    """The sequence form of a policy: ``latent``, ``hidden1``, ``hidden2`` and ``goal`` ``[B, T]`` to ``action``."""
    return TensorDictModule(policy, [*STATES, goal], [action])


class Actor(TensorDictModuleBase):
    """World model and policy as one recurrent TensorDict policy, one time step a call.

    Reads ``pixels`` ``[B, 3, 64, 64]``, ``goal`` ``[B, G]`` and the memories at t, writes ``action`` ``[B, A]`` and
    ``latent`` at t and, under ``next``, the memories and ``predicted_latent`` at t + 1. Memories are zero where they
    are absent and where ``is_init`` (optional, ``[B, 1]``) says that an episode begins.

    In ``env.rollout`` or a collector, append :meth:`make_tensordict_primer` and ``InitTracker`` to the environment.

    Args:
        world_model, policy: what acts.
        pixels, goal, action, is_init: keys.
        mixed: encode frames in the precision of training (see :meth:`WorldModel.encode`), as recipes do.
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
    ):
        super().__init__()
        self.world_model, self.policy, self.mixed = world_model, policy, mixed
        self.pixels, self.goal, self.action, self.is_init = pixels, goal, action, is_init
        recurrent = isinstance(policy, RecurrentPolicy)
        self.policy_memory = tuple(f"policy_{key}" for key in MEMORY) if recurrent else ()
        self.in_keys = [pixels, goal, is_init, *MEMORY, *self.policy_memory]
        self.out_keys = [action, "latent", ("next", "predicted_latent")]
        self.out_keys += [("next", key) for key in (*MEMORY, *self.policy_memory)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        pixels, goal = tensordict.get(self.pixels), tensordict.get(self.goal)
        state = self._recall(tensordict, MEMORY, self.world_model.hidden_size)
        latent = self.world_model.encode(pixels, self.mixed)
        policy_state = None
        if self.policy_memory:
            policy_state = self._recall(tensordict, self.policy_memory, self.policy.lstm.hidden_size)
        action, policy_state = self.policy.step(latent, state[0], state[2], goal, policy_state)
        predicted, state = self.world_model.step(latent, action, state)
        tensordict.set(self.action, action)
        tensordict.set("latent", latent)
        tensordict.set(("next", "predicted_latent"), predicted)
        for key, value in zip(MEMORY, state, strict=True):
            tensordict.set(("next", key), value)
        for key, value in zip(self.policy_memory, policy_state or (), strict=True):
            tensordict.set(("next", key), value)
        return tensordict

    def _recall(self, tensordict: TensorDictBase, keys, size: int) -> tuple[torch.Tensor, ...]:
        device = tensordict.get(self.pixels).device
        zeros = torch.zeros(*tensordict.batch_size, size, device=device)
        state = tuple(tensordict.get(key, zeros) for key in keys)
        is_init = tensordict.get(self.is_init, None)
        if is_init is not None:
            state = tuple(s.masked_fill(is_init, 0.0) for s in state)
        return state

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """The transform that gives an environment the memories, zero at every reset."""
        sizes = dict.fromkeys(MEMORY, self.world_model.hidden_size)
        if self.policy_memory:
            sizes |= dict.fromkeys(self.policy_memory, self.policy.lstm.hidden_size)
        specs = {key: Unbounded((size,)) for key, size in sizes.items()}
        return TensorDictPrimer(Composite(specs), default_value=0.0, expand_specs=True)
