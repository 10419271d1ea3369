"""The state-based expert: its network and the checkpoints that ship with the package (paper, Sec. IV-C)."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from dynmap_rl.runs import load_weights, read_json

CHECKPOINTS = Path(__file__).parent / "checkpoints"


class ExpertNetwork(nn.Module):
    """State ``[..., S]`` to mean and standard deviation of the cart's acceleration ``[..., 3]`` (m/s^2, rad/s^2).

    Args:
        state_size: S.
        acceleration_limit: the largest acceleration of each axis; the mean is a ``tanh`` within it.
        hidden: width of the two hidden layers.
    """

    def __init__(self, state_size: int, acceleration_limit: tuple[float, ...], hidden: int = 128):
        super().__init__()
        size = len(acceleration_limit)
        self.mlp = MLP(state_size, size, num_cells=[hidden, hidden], activation_class=nn.Tanh)
        nn.init.orthogonal_(self.mlp[-1].weight, 0.01)
        nn.init.zeros_(self.mlp[-1].bias)
        self.log_std = nn.Parameter(torch.full((size,), -0.7))
        self.register_buffer("limit", torch.as_tensor(acceleration_limit, dtype=torch.float32))

    def forward(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = torch.tanh(self.mlp(state)) * self.limit
        return mean, (self.log_std.exp() * self.limit).expand_as(mean)


def make_actor(network: ExpertNetwork) -> ProbabilisticActor:
    """The network as a stochastic TensorDict policy: ``state`` to ``action`` and ``action_log_prob``."""
    module = TensorDictModule(network, in_keys=["state"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )


def list_checkpoints(task: str) -> list[str]:
    """The names of a task's shipped checkpoints, earliest first; ``ValueError`` where there is none."""
    names = sorted(path.stem for path in (CHECKPOINTS / task).glob("*.safetensors"))
    if not names:
        raise ValueError(f"no expert is shipped for task {task!r}; train one with recipes/expert.py")
    return names


def load_expert(task: str, checkpoint: str | None = None) -> ExpertNetwork:
    """A shipped expert, the last checkpoint unless one is named. Its facts are in the JSON file beside it."""
    known = list_checkpoints(task)
    checkpoint = checkpoint or known[-1]
    if checkpoint not in known:
        raise ValueError(f"no checkpoint {checkpoint!r} for task {task!r}; choose from {known}")
    facts = read_json(CHECKPOINTS / task / f"{checkpoint}.json")
    network = ExpertNetwork(facts["state_size"], tuple(facts["acceleration_limit"]), facts["hidden"])
    load_weights(CHECKPOINTS / task / f"{checkpoint}.safetensors", network)
    return network.eval().requires_grad_(False)
