"""MuJoCo tasks as the LeRobot environment ``dynmap``."""

import numpy as np
import pytest
import torch
from lerobot.envs import make_env, make_env_config
from lerobot.scripts.lerobot_eval import rollout
from own_task import own_task  # noqa: F401
from torch import nn

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.integrations import lerobot  # noqa: F401  registers the environment


class Demonstrate(nn.Module):
    """Policy that acts as the task's demonstrator, from the same seeds."""

    def __init__(self, task, seeds):
        super().__init__()
        self.task, self.seeds, self.seen = task, seeds, []

    def reset(self):
        self.worlds = [self.task.begin(seed) for seed in self.seeds]
        self.experts = [self.task.demonstrator(world) for world in self.worlds]

    def select_action(self, batch):
        self.seen.append(batch)
        actions = [expert() for expert in self.experts]
        self.task.step(self.worlds, actions)
        return torch.from_numpy(np.stack(actions)).float()


@pytest.mark.parametrize("arguments", ["", ":image_size=96,cameras=2"])
def test_the_demonstrator_succeeds_in_lerobots_environment(own_task, arguments):  # noqa: F811
    name = own_task + arguments
    config = make_env_config("dynmap", task=name)
    env, task = make_env(config, n_envs=2)["dynmap"][0], get_task(name)
    policy = Demonstrate(task, [scene_seed("test", i) for i in (0, 1)])
    same = lambda value: value  # noqa: E731
    result = rollout(env, policy, *config.get_env_processors(), same, same, seeds=[0, 1])
    env.close()
    assert result["action"].shape == (2, 40, 1) and result["success"][:, -1].all()
    assert not result["success"][:, :-1].any()
    assert (config.fps, config.episode_length) == (20, 40)
    assert policy.seen[0]["observation.state"].shape == (2, 6)
    side, cameras = task.image_size, task.layout.cameras
    for camera in cameras:
        assert policy.seen[0][f"observation.images.{camera}"].shape == (2, 3, side, side)
    mapped = {config.features_map[name]: feature.shape for name, feature in config.features.items()}
    assert mapped["observation.images.front"] == (side, side, 3) and len(mapped) == 2 + len(cameras)
