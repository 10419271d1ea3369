"""Two LSTM layers in a row, in sequence form (training) and step form (control), with one set of weights."""

from __future__ import annotations

import torch
from torch import nn

State = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class TwoLSTM(nn.Module):
    """Two LSTM layers that return the hidden states of both layers at every step.

    The state is ``(hidden1, cell1, hidden2, cell2)``, each ``[B, H]``.

    Args:
        input_size: entries of the input.
        hidden_size: H.
    """

    def __init__(self, input_size: int, hidden_size: int):
        super().__init__()
        # num_layers=2 would hide the first layer's states.
        self.lstm1 = nn.LSTM(input_size, hidden_size, batch_first=True)
        self.lstm2 = nn.LSTM(hidden_size, hidden_size, batch_first=True)
        self.hidden_size = hidden_size

    def train(self, mode: bool = True) -> TwoLSTM:
        """Stay in training mode: cuDNN has no gradients in the other one, and without dropout both give the same."""
        return super().train()

    def forward(
        self, x: torch.Tensor, state: State | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, State]:
        """Map ``[B, T, input]`` to ``hidden1``, ``hidden2`` ``[B, T, H]`` after each step, and the last state.

        Without ``state``, the windows begin with zeros.

        Raises:
            ValueError: the input is no batch of windows.
        """
        if x.ndim != 3:  # nn.LSTM would take it as one window
            raise ValueError(f"windows must be [B, T, ...], got an input of shape {list(x.shape)}")
        state1 = state2 = None
        if state is not None:
            h1, c1, h2, c2 = (s[None].contiguous() for s in state)
            state1, state2 = (h1, c1), (h2, c2)
        hidden1, (h1, c1) = self.lstm1(x, state1)
        hidden2, (h2, c2) = self.lstm2(hidden1, state2)
        return hidden1, hidden2, (h1[0], c1[0], h2[0], c2[0])

    def step(self, x: torch.Tensor, state: State) -> State:
        """Map one step's input ``[..., input]`` and the state, ``[..., H]`` each, to the next state."""
        flat = tuple(s.reshape(-1, self.hidden_size) for s in state)
        after = self(x.reshape(-1, 1, x.shape[-1]), flat)[2]
        return tuple(s.reshape(*x.shape[:-1], self.hidden_size) for s in after)

    def initial_state(self, batch: int, device=None) -> State:
        """Return the state at the start of B episodes: four zero tensors ``[B, H]``."""
        return tuple(torch.zeros(batch, self.hidden_size, device=device) for _ in range(4))


def delay(x: torch.Tensor) -> torch.Tensor:
    """Shift ``[B, T, ...]`` by one step: out[:, t] = x[:, t-1], and zeros at t = 0.

    A recurrent module that reads step t predicts step t + 1; the shift stores the prediction at its own time.
    """
    return torch.cat([torch.zeros_like(x[:, :1]), x[:, :-1]], 1)
