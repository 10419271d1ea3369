"""Baseline for late frames: a feed-forward policy that reads an old state and the actions sent since.

A decision process with delayed observations is an ordinary one whose state also has the actions since the last
observation (Katsikopoulos and Engelbrecht 2003). So a policy can learn to bridge a delay, without a world model that is
rolled forward.
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.nn import functional as F
from tqdm import tqdm

from dynmap_rl.data.demonstrations import load_demonstrations
from dynmap_rl.data.features import compute_features
from dynmap_rl.modules.actor import MEMORY
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import imitation_loss
from dynmap_rl.training.loop import make_optimizer, set_learning_rate, step
from dynmap_rl.training.settings import PolicyTraining
from dynmap_rl.utils.devices import seed_everything

LONGEST = 30  # steps; longest delay of the policy


class PastActionsPolicy(nn.Module):
    """MLP policy ``a_t = pi(z_k, h_k, g, a_{k-1}, ..., a_{t-1}, t - k)`` on the state of the step k of the newest frame.

    The action before the frame is known to the state too. But the policy learns to repeat the newest action of its input with
    small changes, and would fail without a delay if there were none.

    Args:
        latent_size: Z of the world model.
        hidden_size: H of the world model.
        action: normaliser of the actions; its size is A.
        goal: normaliser of the goals; its size is G.
        max_delay: longest delay K in steps.
        width: width of the hidden layers.
    """

    def __init__(
        self,
        latent_size: int,
        hidden_size: int,
        action: Normalizer,
        goal: Normalizer,
        max_delay: int = LONGEST,
        width: int = 256,
    ):
        super().__init__()
        self.action, self.goal, self.max_delay = action, goal, max_delay
        inputs = latent_size + 2 * hidden_size + goal.size + max_delay * action.size + 1
        self.layers = nn.Sequential(
            nn.Linear(inputs, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, action.size),
        )

    def forward(self, latent, hidden1, hidden2, goal, past, age) -> torch.Tensor:
        """Return actions ``[..., A]`` (SI units).

        Args:
            latent: of the newest frame, ``[..., Z]``.
            hidden1: before that frame, ``[..., H]``.
            hidden2: before that frame, ``[..., H]``.
            goal: ``[..., G]`` (SI units).
            past: the last K actions, the latest one last, ``[..., K, A]`` (SI units). Those more than a step before the frame
                are not read.
            age: steps since the frame, int64 ``[..., 1]``, at most K.
        """
        steps = torch.arange(self.max_delay, 0, -1, device=age.device)
        past = self.action.normalize(past) * (steps <= age + 1).unsqueeze(-1)
        share = age / self.max_delay
        features = torch.cat(
            [latent, hidden1, hidden2, self.goal.normalize(goal), past.flatten(-2), share], -1
        )
        return self.action.denormalize(self.layers(features))


def train_past_actions(
    policy: PastActionsPolicy,
    features: TensorDictBase,
    executed: torch.Tensor,
    settings: PolicyTraining,
    seed: int = 0,
) -> None:
    """Minimise the L1 imitation loss, with a random delay for every episode of a batch.

    Args:
        policy: changed in place.
        features: training states ``[E, T]`` of :func:`dynmap_rl.data.compute_features`.
        executed: actions that were executed, ``[E, T, A]`` (SI units).
        settings: updates, batch, learning rate and emphasis.
        seed: seed of the batches.
    """
    optimizer = make_optimizer(policy, settings.learning_rate, weight_decay=1e-3)
    generator, steps = torch.Generator().manual_seed(seed), features.shape[1]
    past = (
        F.pad(executed, (0, 0, policy.max_delay, 0))[:, :-1].unfold(1, policy.max_delay, 1).mT
    )  # (E, T, K, A)
    for update in tqdm(range(settings.updates), "policy with past actions"):
        set_learning_rate(optimizer, settings.learning_rate, update, settings.updates)
        index = torch.randint(len(features), (settings.batch,), generator=generator)
        delay = torch.randint(policy.max_delay + 1, (settings.batch, 1), generator=generator)
        age = delay.clamp(max=torch.arange(steps))  # (B, T)
        batch, frame = features[index], torch.arange(steps) - age
        states = [
            batch[name][torch.arange(settings.batch)[:, None], frame]
            for name in ("latent", "hidden1", "hidden2")
        ]
        action = policy(*states, batch["goal"], past[index], age[..., None])
        loss = imitation_loss(action, batch["action"], policy.action, batch["disturbed"], settings.emphasis)
        step(loss, optimizer)


def make_past_actions_actor(
    world_model: WorldModel, dataset: str | Path, settings: PolicyTraining, seed: int = 0
) -> PastActionsActor:
    """Train a :class:`PastActionsPolicy` on a frozen world model; make its actor.

    Args:
        world_model: frozen; stays as it is.
        dataset: folder or hub id.
        settings: updates, batch, learning rate and emphasis.
        seed: seed of the weights and batches.
    """
    episodes, constants = load_demonstrations(dataset)
    train = episodes["train"]
    seed_everything(1000 + seed)
    action, goal = (Normalizer(**constants[name]) for name in ("action", "goal"))
    policy = PastActionsPolicy(world_model.latent_size, world_model.hidden_size, action, goal)
    train_past_actions(policy, compute_features(world_model, train), train["action"], settings, seed)
    return PastActionsActor(world_model, policy)


class PastActionsActor(TensorDictModuleBase):
    """World model and :class:`PastActionsPolicy` as an actor for frames that all have the same delay.

    It reads ``pixels``, the newest frame that has arrived, ``delay``, its age, and ``goal``; it writes ``action``. The
    world model filters the frames that have arrived, each with the action that followed it.

    Args:
        world_model: encoder and transition.
        policy: policy.

    Calling it raises ``ValueError`` for a delay above the policy's ``max_delay``.
    """

    def __init__(self, world_model: WorldModel, policy: PastActionsPolicy):
        super().__init__()
        self.model, self.policy = world_model, policy
        self.in_keys, self.out_keys = ["pixels", "delay", "goal", "memory"], ["action", ("next", "memory")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next memory."""
        batch, policy, model = tensordict.batch_size, self.policy, self.model
        memory, age = tensordict.get("memory", None), tensordict["delay"]
        if age.max() > policy.max_delay:
            raise ValueError(f"delay must be at most {policy.max_delay} steps, got {age.max()}")
        latent = model.encode(tensordict["pixels"], mixed=True)
        if memory is None:
            state = model.initial_state(len(latent), latent.device)
            past = latent.new_zeros(*batch, policy.max_delay + 1, policy.action.size)
        else:
            state, past = tuple(memory[name] for name in MEMORY), memory["past"]
            followed = past.take_along_dim((policy.max_delay - age)[..., None], -2).squeeze(-2)
            _, after = model.step(memory["latent"], followed, state)
            newer = age <= memory["age"]  # otherwise the frame is that of the last step
            state = tuple(torch.where(newer, *pair) for pair in zip(after, state, strict=True))
        action = policy(latent, state[0], state[2], tensordict["goal"], past[..., 1:, :], age)
        past = torch.cat([past[..., 1:, :], action.unsqueeze(-2)], -2)
        memory = dict(zip(MEMORY, state, strict=True)) | {"latent": latent, "age": age, "past": past}
        tensordict.set(("next", "memory"), TensorDict(memory, batch))
        return tensordict.set("action", action)
