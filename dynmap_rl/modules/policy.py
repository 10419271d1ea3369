"""Goal-conditioned policies on the world model's states (paper, Eq. 1 and 2)."""

from __future__ import annotations

import torch
from torch import nn

from .normalization import Normalizer
from .recurrent import State, TwoLSTM


class FeedforwardPolicy(nn.Module):
    """MLP policy ``a_t = pi(z_t, h_t, g)`` (paper, Eq. 1).

    Args:
        latent_size: Z of the world model.
        hidden_size: H of the world model.
        action: normaliser of the actions; its size is A.
        goal: normaliser of the goals; its size is G.
        width: width of the hidden layers.
    """

    kind = "feedforward"

    def __init__(
        self,
        latent_size: int,
        hidden_size: int,
        action: Normalizer,
        goal: Normalizer,
        width: int = 256,
    ):
        super().__init__()
        self.action, self.goal, self.width = action, goal, width
        self.layers = nn.Sequential(
            nn.Linear(latent_size + 2 * hidden_size + goal.size, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, action.size),
        )

    def forward(self, latent, hidden1, hidden2, goal) -> torch.Tensor:
        """Map ``[..., Z]``, ``[..., H]`` twice and goals ``[..., G]`` (SI units) to actions ``[..., A]`` (SI units)."""
        features = torch.cat([latent, hidden1, hidden2, self.goal.normalize(goal)], -1)
        return self.action.denormalize(self.layers(features))

    def step(self, latent, hidden1, hidden2, goal, state: State | None = None):
        """Act for one time step; the state passes through, so that both policies have the same interface."""
        return self(latent, hidden1, hidden2, goal), state

    def initial_state(self, batch: int, device=None) -> None:
        """Return None, as the policy has no memory."""
        return None


class RecurrentPolicy(nn.Module):
    """Policy with two LSTM cells of its own, ``a_t, h_pi_{t+1} = pi(z_t, g, h_t, h_pi_t)`` (paper, Eq. 2).

    Args:
        latent_size: Z of the world model.
        hidden_size: H of the world model.
        action: normaliser of the actions; its size is A.
        goal: normaliser of the goals; its size is G.
        width: hidden size of the policy's cells.
    """

    kind = "recurrent"

    def __init__(
        self,
        latent_size: int,
        hidden_size: int,
        action: Normalizer,
        goal: Normalizer,
        width: int = 128,
    ):
        super().__init__()
        self.action, self.goal, self.width = action, goal, width
        self.embed = nn.Sequential(nn.Linear(latent_size + 2 * hidden_size + goal.size, width), nn.SiLU())
        self.lstm = TwoLSTM(width, width)
        self.head = nn.Sequential(nn.Linear(2 * width, width), nn.SiLU(), nn.Linear(width, action.size))

    def forward(self, latent, hidden1, hidden2, goal) -> torch.Tensor:
        """Act for a sequence ``[B, T, ...]``, from ``h_pi_0 = 0``; actions ``[B, T, A]`` (SI units)."""
        x = self._embed(latent, hidden1, hidden2, goal)
        _, top, _ = self.lstm(x)
        return self._act(x, top)

    def step(self, latent, hidden1, hidden2, goal, state: State) -> tuple[torch.Tensor, State]:
        """Act for one step: ``[B, ...]`` each and ``h_pi_t`` to actions ``[B, A]`` and ``h_pi_{t+1}``."""
        x = self._embed(latent, hidden1, hidden2, goal)
        state = self.lstm.step(x, state)
        return self._act(x, state[2]), state

    def initial_state(self, batch: int, device=None) -> State:
        """Return the memory at the start of B episodes: four zero tensors ``[B, width]``."""
        return self.lstm.initial_state(batch, device)

    def _embed(self, latent, hidden1, hidden2, goal) -> torch.Tensor:
        return self.embed(torch.cat([latent, hidden1, hidden2, self.goal.normalize(goal)], -1))

    def _act(self, x: torch.Tensor, top: torch.Tensor) -> torch.Tensor:
        return self.action.denormalize(self.head(torch.cat([x, top], -1)))
