"""The LeRobot environment ``dynmap``: observations, scenes, success."""

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.envs import make_env, make_env_config, preprocess_observation
from lerobot.scripts.lerobot_eval import rollout
from tensordict import TensorDict
from torch import nn

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.integrations.lerobot.environment import DynmapEnvConfig
from dynmap_rl.keys import GYMNASIUM_IDS

TASKS = tuple(GYMNASIUM_IDS)


class Replay(nn.Module):
    """Policy that returns known actions ``[T, B, 3]`` and keeps the observations."""

    def __init__(self, actions):
        super().__init__()
        self.actions, self.seen = actions, []

    def reset(self):
        self.step = 0

    def select_action(self, batch):
        self.seen.append(batch)
        self.step += 1
        return self.actions[self.step - 1]


def identity(value):
    return value


@pytest.mark.parametrize(
    "task", [TASKS[0], *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS[1:])]
)
def test_a_replayed_demonstration_shows_the_recorded_frames_and_succeeds(recordings, task):
    config = make_env_config("dynmap", task=task, split="train")
    env = make_env(config, n_envs=1)["dynmap"][0]
    episode = load_dataset(recordings(task))[0]
    seed = load_meta(recordings(task))["episodes"][0]["scene_seed"]  # of the split train, which begins at 0
    policy = Replay(episode["action"][:, None])
    env_pre, env_post = config.get_env_processors()
    result = rollout(env, policy, env_pre, env_post, identity, identity, seeds=[seed])
    assert result["action"].shape == (1, 120, 3)
    assert result["success"][0, -1]
    assert result["done"][0].sum() == 1
    for t in (0, 60, 119):
        frame = policy.seen[t]["observation.images.front"][0]
        assert torch.equal((frame * 255).round().byte(), episode["pixels"][t])
        assert torch.equal(policy.seen[t]["observation.state"][0], episode["agent_pos"][t])
    assert policy.seen[0]["task"] == list(env.call("task_description"))
    env.close()


def test_episodes_that_end_before_the_others_are_no_success():
    config = DynmapEnvConfig()
    env = make_env(config, n_envs=2)["dynmap"][0]
    fall = torch.tensor([[0.02, 0.0, 0.05], [0.0, 0.0, 0.0]])  # the first turns until the block falls
    policy = Replay(fall.expand(120, 2, 3))
    result = rollout(env, policy, *config.get_env_processors(), identity, identity, seeds=[0, 1])
    assert result["done"].float().argmax(1).tolist()[0] < 119
    assert not result["success"].any()
    env.close()


def test_env_config_has_the_features_of_the_dataset(recording):
    config = DynmapEnvConfig(task="bin_dropping")
    features = LeRobotDataset("user/small", root=recording, video_backend="pyav").features
    for key, feature in config.features.items():
        assert tuple(features[config.features_map[key]]["shape"]) == feature.shape
    observation = make_env(config, n_envs=3)["dynmap"][0].reset(seed=0)[0]
    assert preprocess_observation(observation)["observation.image"].shape == (3, 3, 64, 64)


def test_seeds_count_within_the_test_split():
    env = make_env(DynmapEnvConfig(), n_envs=1)["dynmap"][0]
    scenes = DynmapBatchedEnv("balance_reaching", 1, from_pixels=True)
    expected = scenes.reset(TensorDict({"scene_seed": torch.tensor(scene_seeds("test", 8)[7:])}, [1]))
    pixels = env.reset(seed=7)[0]["pixels"]
    assert (torch.from_numpy(pixels).permute(0, 3, 1, 2) == expected["pixels"]).all()
    env.close()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("task", "chess"),
        ("task", None),
        ("fps", 30),
        ("episode_length", 60),
        ("split", "dev"),
        ("render_size", 255),
        ("render_size", 0),
    ],
)
def test_env_config_refuses_other_values(field, value):
    with pytest.raises(ValueError, match=str(value)):
        DynmapEnvConfig(**{field: value})


def test_late_frames():
    config = make_env_config("dynmap", delay=2)
    env = make_env(config, n_envs=2)["dynmap"][0]
    on_time = make_env(make_env_config("dynmap"), n_envs=2)["dynmap"][0]
    actions = 0.005 * torch.rand(120, 2, 3, generator=torch.Generator().manual_seed(0))
    frames = []
    for each in (env, on_time):
        policy = Replay(actions)
        rollout(each, policy, *config.get_env_processors(), identity, identity, seeds=[0, 1])
        frames.append([seen["observation.images.front"] for seen in policy.seen])
        each.close()
    late, present = frames
    assert all(torch.equal(late[t], present[max(t - 2, 0)]) for t in range(10))
    assert not torch.equal(late[9], present[9])
    with pytest.raises(ValueError, match="jitter"):
        DynmapEnvConfig(delay=1, jitter=2)
