"""The world asks for balance: controllers that pay no attention to the block lose it."""

import pytest
import torch
from torch import nn

from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.evaluation.experts import list_outcomes
from dynmap_rl.experts.careless import CarelessController
from dynmap_rl.experts.network import play_to_end

TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"


class WhiteNoise(nn.Module):
    """Every acceleration is the limit, with a random sign."""

    def forward(self, state):
        signs = torch.randint(0, 2, (*state.shape[:-1], 3)) * 2 - 1
        acceleration = signs * torch.as_tensor(ACCELERATION_LIMIT, dtype=torch.float32)
        return acceleration, torch.zeros_like(acceleration)


def share_dropped(network, name, count=40):
    task = get_task(name)
    dropped = list_outcomes(task, play_to_end(network, task, scene_seeds("validation", count)))["dropped"]
    return sum(dropped) / count


@pytest.mark.parametrize("name", TASKS)
def test_the_careless_controller_drops_most_blocks(name):
    assert share_dropped(CarelessController(get_task(name)), name) > 0.7


@pytest.mark.parametrize("name", TASKS)
def test_white_noise_drops_nearly_all_blocks(name):
    torch.manual_seed(0)
    assert share_dropped(WhiteNoise(), name) > 0.9


def test_the_careless_controller_goes_to_the_goal_and_stays():
    task = get_task("balance_reaching")
    worlds = play_to_end(CarelessController(task), task, scene_seeds("validation", 10))
    assert max(world.position_error for world in worlds) < 0.05  # m
