"""State-based experts: network, checkpoints and rollouts (paper, Sec. IV-C)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor

from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import EPISODE_STEPS, World, step_worlds
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.weights import load_module

CHECKPOINTS = Path(__file__).parent / "checkpoints"


class ExpertNetwork(nn.Module):
    """Normal distribution of the cart's acceleration, from the state.

    Args:
        state_size: S, entries of the state.
        acceleration_limit: largest acceleration of each axis (m/s^2, m/s^2, rad/s^2); the mean is a ``tanh`` within.
        hidden: width of the two hidden layers.
    """

    def __init__(self, state_size: int, acceleration_limit: tuple[float, ...], hidden: int = 128):
        super().__init__()
        size = len(acceleration_limit)
        self.mlp = MLP(state_size, size, num_cells=[hidden, hidden], activation_class=nn.Tanh)
        nn.init.orthogonal_(self.mlp[-1].weight, 0.01)
        nn.init.zeros_(self.mlp[-1].bias)
        self.log_std = nn.Parameter(torch.full((size,), -1.2))
        self.register_buffer("limit", torch.as_tensor(acceleration_limit, dtype=torch.float32))

    def forward(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return mean and standard deviation ``[..., 3]`` (m/s^2, m/s^2, rad/s^2) for states ``[..., S]``."""
        mean = torch.tanh(self.mlp(state)) * self.limit
        return mean, (self.log_std.exp() * self.limit).expand_as(mean)


def make_actor(network: ExpertNetwork) -> ProbabilisticActor:
    """Make a stochastic TensorDict policy: ``state`` to ``action`` and ``action_log_prob``."""
    module = TensorDictModule(network, in_keys=["state"], out_keys=["loc", "scale"])
    return ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=IndependentNormal, return_log_prob=True
    )


@torch.no_grad()
def play(
    network: ExpertNetwork,
    task: Task,
    scene_seeds: Sequence[int],
    states: Task | None = None,
) -> Iterator[list[World]]:
    """Yield the worlds before each of the 120 steps of the mean action; afterwards they are in their final state.

    Args:
        network: expert.
        task: task to play.
        scene_seeds: one world each.
        states: task whose ``state`` the expert was trained on, where it is not ``task``.
    """
    worlds = [task.make_world(task.sample_scene(np.random.default_rng(seed))) for seed in scene_seeds]
    for _ in range(EPISODE_STEPS):
        yield worlds
        state = np.stack([(states or task).state(world) for world in worlds])
        mean, _ = network(torch.from_numpy(state))
        actions = [world.action_for(a) for world, a in zip(worlds, mean.numpy(), strict=True)]
        step_worlds(worlds, actions)


def play_to_end(
    network: ExpertNetwork,
    task: Task,
    scene_seeds: Sequence[int],
    states: Task | None = None,
) -> list[World]:
    """Play episodes to the end (see :func:`play`) and return the worlds."""
    [worlds] = deque(play(network, task, scene_seeds, states), maxlen=1)
    return worlds


def list_checkpoints(expert: str | Path) -> list[str]:
    """Return the names of an expert's checkpoints, earliest first.

    Args:
        expert: name of a task whose expert ships with the package, or the ``checkpoint`` folder of a run of
            ``recipes/expert.py``.

    Raises:
        ValueError: there is no checkpoint.
    """
    names = [path.stem for path in find_expert(expert).glob("*.safetensors")]
    names.sort(key=lambda name: (len(name), name))  # iteration_1000 after iteration_995
    if not names:
        raise ValueError(
            f"no expert at {expert}; train one with recipes/expert.py and give its checkpoint folder, or give a task of "
            "your own a demonstrator"
        )
    return names


def load_expert(expert: str | Path, checkpoint: str | None = None) -> ExpertNetwork:
    """Load an expert (see :func:`list_checkpoints`).

    Args:
        expert: name of a task, or a folder of checkpoints.
        checkpoint: name of the checkpoint; by default the last one.

    Raises:
        ValueError: there is no such checkpoint, or it is damaged.
    """
    known = list_checkpoints(expert)
    checkpoint = checkpoint or known[-1]
    if checkpoint not in known:
        raise ValueError(f"the checkpoint of {expert} must be one of {', '.join(known)}, got {checkpoint!r}")
    folder = find_expert(expert)
    facts = read_json(folder / f"{checkpoint}.json")

    def make() -> ExpertNetwork:
        return ExpertNetwork(facts["state_size"], tuple(facts["acceleration_limit"]), facts["hidden"])

    return load_module(folder / f"{checkpoint}.safetensors", make).eval().requires_grad_(False)


def task_of_expert(expert: str | Path, task: Task) -> Task:
    """Return the task whose ``state`` an expert was trained on.

    Args:
        expert: see :func:`list_checkpoints`.
        task: task that the expert shall play.

    Raises:
        ValueError: ``task`` does not have these states.
    """
    facts = read_json(find_expert(expert) / f"{list_checkpoints(expert)[-1]}.json", {"task": str})
    trained_on = get_task(facts["task"], from_file=True)
    if not isinstance(task, Task) or not issubclass(task.ranges.scene, trained_on.ranges.scene):
        raise ValueError(
            f"the expert {expert} reads states of {trained_on.name}, which {task.name} does not have; choose another "
            "--expert"
        )
    return trained_on


def find_expert(expert: str | Path) -> Path:
    """Return the folder of an expert's checkpoints, shipped or named by its path."""
    shipped = CHECKPOINTS / expert
    return shipped if shipped.is_dir() and shipped.parent == CHECKPOINTS else Path(expert).expanduser()
