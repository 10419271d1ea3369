"""The transition model: ``(z_hat_{t+1}, h_{t+1}) = DYN(z_t, a_t, h_t)`` (paper, Sec. III-A)."""

from __future__ import annotations

import torch
from torch import nn

from .normalization import Normalizer
from .recurrent import State, TwoLSTM, delay


class Transition(nn.Module):
    """Two LSTM layers on latent and action, which predict the change of the latent.

    Args:
        action: normaliser of the actions; its size is A.
        latent_size: Z.
        hidden_size: H.
    """

    def __init__(self, action: Normalizer, latent_size: int = 64, hidden_size: int = 128):
        super().__init__()
        self.action = action
        self.lstm = TwoLSTM(latent_size + action.size, hidden_size)
        self.change = nn.Linear(hidden_size, latent_size)

    def forward(
        self, latent: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Predict a sequence, from ``h_0 = 0``.

        Args:
            latent: z, ``[B, T, Z]``.
            action: ``[B, T, A]`` (SI units).

        Returns:
            ``predicted_latent`` ``[B, T, Z]`` and ``hidden1``, ``hidden2`` ``[B, T, H]``. The entry at t is predicted
            from everything before t. At t = 0 there is no prediction, and the entries are zeros.
        """
        hidden1, hidden2, _ = self.lstm(torch.cat([latent, self.action.normalize(action)], -1))
        predicted = latent + self.change(hidden2)
        return delay(predicted), delay(hidden1), delay(hidden2)

    def imagine(
        self, latent: torch.Tensor, action: torch.Tensor, context: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Predict a sequence, reading latents before step ``context`` (1 or more) and own predictions from there on.

        Arguments and results are those of :meth:`forward`.
        """
        seen, actions = latent[:, :context], self.action.normalize(action)
        hidden1, hidden2, state = self.lstm(torch.cat([seen, actions[:, :context]], -1))
        steps = [(seen + self.change(hidden2), hidden1, hidden2)]
        for t in range(context, latent.shape[1]):
            predicted, state = self.step(steps[-1][0][:, -1], action[:, t], state)
            steps.append((predicted[:, None], state[0][:, None], state[2][:, None]))
        return tuple(delay(torch.cat(part, 1)) for part in zip(*steps, strict=True))

    def step(self, latent: torch.Tensor, action: torch.Tensor, state: State) -> tuple[torch.Tensor, State]:
        """Predict one step: ``z_t`` ``[B, Z]``, ``a_t`` ``[B, A]`` and ``h_t`` to ``z_hat_{t+1}`` and ``h_{t+1}``."""
        state = self.lstm.step(torch.cat([latent, self.action.normalize(action)], -1), state)
        return latent + self.change(state[2]), state
