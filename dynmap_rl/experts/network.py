"""The state-based expert: its network and the checkpoints that ship with the package (paper, Sec. IV-C)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from dynmap_rl.envs.tasks import BalanceReaching, get_task
from dynmap_rl.envs.world import EPISODE_STEPS, World, step_worlds
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.weights import load_module

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


@torch.no_grad()
def play(
    network: ExpertNetwork,
    task: BalanceReaching,
    scene_seeds: Sequence[int],
    states: BalanceReaching | None = None,
) -> Iterator[list[World]]:
    """The worlds before each of the 120 steps of the mean action, one world a scene seed; in the end they are as the
    last step left them.

    Args:
        states: the task whose ``state`` the expert was trained on, where it is not ``task``.
    """
    worlds = [task.make_world(task.sample_scene(np.random.default_rng(seed))) for seed in scene_seeds]
    for _ in range(EPISODE_STEPS):
        yield worlds
        state = np.stack([(states or task).state(world) for world in worlds])
        mean, _ = network(torch.from_numpy(state))
        actions = [world.action_for(a) for world, a in zip(worlds, mean.numpy(), strict=True)]
        step_worlds(worlds, actions, torch.get_num_threads())


def roll_out(
    network: ExpertNetwork,
    task: BalanceReaching,
    scene_seeds: Sequence[int],
    states: BalanceReaching | None = None,
) -> list[World]:
    """:func:`play` to the end: the worlds as they are then."""
    [worlds] = deque(play(network, task, scene_seeds, states), maxlen=1)
    return worlds


def list_checkpoints(expert: str | Path) -> list[str]:
    """The names of an expert's checkpoints, earliest first.

    Args:
        expert: the name of a task whose expert ships with the package, or the ``checkpoint`` folder of a run of
            ``recipes/expert.py``.

    Raises:
        ValueError: there is none.
    """
    names = [path.stem for path in find_expert(expert).glob("*.safetensors")]
    names.sort(key=lambda name: (len(name), name))  # iteration_1000 after iteration_995
    if not names:
        raise ValueError(
            f"no expert at {expert}; train one with recipes/expert.py and name its checkpoint folder"
        )
    return names


def load_expert(expert: str | Path, checkpoint: str | None = None) -> ExpertNetwork:
    """An expert (see :func:`list_checkpoints`), the last checkpoint unless one is named. Its facts are in the JSON
    file beside it."""
    known = list_checkpoints(expert)
    checkpoint = checkpoint or known[-1]
    if checkpoint not in known:
        raise ValueError(f"no checkpoint {checkpoint!r} of the expert {expert}; choose from {known}")
    folder = find_expert(expert)
    facts = read_json(folder / f"{checkpoint}.json")

    def make() -> ExpertNetwork:
        return ExpertNetwork(facts["state_size"], tuple(facts["acceleration_limit"]), facts["hidden"])

    return load_module(folder / f"{checkpoint}.safetensors", make).eval().requires_grad_(False)


def task_of_expert(expert: str | Path, task: BalanceReaching) -> BalanceReaching:
    """The task whose ``state`` an expert sees (see :func:`list_checkpoints`), which it can play ``task`` by.

    Raises:
        ValueError: ``task`` has no such states.
    """
    facts = read_json(find_expert(expert) / f"{list_checkpoints(expert)[-1]}.json", {"task": str})
    sees = get_task(facts["task"], from_file=True)
    if not issubclass(task.ranges.scene, sees.ranges.scene):
        raise ValueError(f"the expert {expert} sees states of {sees.name}, which {task.name} does not have")
    return sees


def find_expert(expert: str | Path) -> Path:
    """The folder of an expert's checkpoints: one that ships with the package, by its name, or the path itself."""
    shipped = CHECKPOINTS / expert
    return shipped if shipped.is_dir() else Path(expert)
