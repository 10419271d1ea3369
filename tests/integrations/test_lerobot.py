"""The environment and the policy that LeRobot sees."""

import dataclasses
import json
import shutil

import pytest
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.envs import make_env, make_env_config, preprocess_observation
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from tensordict import TensorDict
from torch import nn

from dynmap_rl import modules  # MODULE
from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.evaluation.rollout import scene_seeds
from dynmap_rl.integrations.lerobot.configuration_dynmap import DynmapConfig
from dynmap_rl.integrations.lerobot.environment import DynmapEnvConfig
from dynmap_rl.integrations.lerobot.modeling_dynmap import DynmapPolicy
from dynmap_rl.utils.weights import fingerprint

TASKS = ("balance_reaching", "balance_reaching_obstacle", "bin_dropping")
SMALL = {"device": "cpu", "push_to_hub": False, "window_steps": 6, "rgb_steps": 2}


class Replay(nn.Module):
    """A policy that gives known actions ``[T, B, 3]``, and keeps what it was shown."""

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


@pytest.mark.parametrize("task", TASKS)
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


def test_env_config_names_what_the_dataset_names(recording):
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
    ("field", "value"), [("task", "chess"), ("fps", 30), ("episode_length", 60), ("split", "dev")]
)
def test_env_config_refuses_what_the_tasks_are_not(field, value):
    with pytest.raises(ValueError, match="balance_reaching|unknown split"):
        DynmapEnvConfig(**{field: value})


def load_windows(recording, policy, starts, episodes=None):
    """What LeRobot's loader and preprocessor make of the windows from these frames on."""
    arguments = {"root": recording, "episodes": episodes, "video_backend": "pyav"}
    dataset = LeRobotDataset("user/small", **arguments)
    delta = resolve_delta_timestamps(policy.config, dataset.meta)
    dataset = LeRobotDataset("user/small", **arguments, delta_timestamps=delta)
    batch = torch.utils.data.default_collate([dataset[i] for i in starts])
    return make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)[0](batch)


def new_policy(recording, episodes=None, **settings):
    dataset = LeRobotDataset("user/small", root=recording, episodes=episodes, video_backend="pyav")
    return make_policy(make_policy_config("dynmap", **(SMALL | settings)), ds_meta=dataset.meta)


def test_windows_are_those_of_our_own_loader(recording):
    policy = new_policy(recording)
    batch = load_windows(recording, policy, [0, 130, 237])  # the last goes 3 steps beyond its episode
    windows = policy.make_windows(batch)
    episodes = load_dataset(recording)
    assert windows.shape == (3, 6)
    for row, episode, steps in (
        (0, 0, range(6)),
        (1, 1, range(10, 16)),
        (2, 1, [117, 118, 119, 119, 119, 119]),
    ):
        expected = episodes[episode][list(steps)]
        for key in ("pixels", "action", "goal", "dynamics"):
            assert (windows[row][key] == expected[key]).all(), key
        assert torch.equal(windows["disturbed"][row], expected["disturbed"])
        there = [row != 2 or step < 3 for step in range(6)]
        assert windows["collector", "mask"][row].tolist() == there


def test_a_part_from_the_middle_has_its_own_dynamics(recording, tmp_path):
    """Where LeRobot has downloaded the data files of some episodes alone."""
    part = shutil.copytree(recording, tmp_path / "part")
    files = sorted((part / "data").glob("*/*.parquet"))
    assert len(files) == 3, "two episodes in each"
    files[0].unlink(), files[2].unlink()
    policy = new_policy(part, [2, 3])
    windows = policy.make_windows(load_windows(part, policy, [0, 130], [2, 3]))
    expected = load_dataset(recording)[2:4]
    assert (windows["dynamics"][0] == expected["dynamics"][0, :6]).all()
    assert (windows["dynamics"][1] == expected["dynamics"][1, 10:16]).all()
    assert torch.equal(windows["disturbed"][1], expected["disturbed"][1, 10:16])

    shutil.copy(files[1], files[2])
    with pytest.raises(ValueError, match="frames with the same index"):
        new_policy(part, [2, 3])


@pytest.mark.parametrize(
    ("supervision", "kind", "terms"),
    [
        ("none", "feedforward", {"rgb", "latent", "policy"}),
        ("position,acceleration", "recurrent", {"rgb", "latent", "policy", "position", "acceleration"}),
    ],
)
def test_the_loss_is_that_of_the_config(recording, supervision, kind, terms):
    policy = new_policy(recording, supervision=supervision, kind=kind).train()
    loss, parts = policy(load_windows(recording, policy, [0, 130]))
    loss.backward()
    assert set(parts) == {f"loss_{term}" for term in terms}
    assert loss.item() == pytest.approx(sum(parts.values()), rel=1e-5)
    assert all(p.grad is not None for p in policy.parameters())


def test_constants_are_those_of_the_recording_and_are_saved(recording, tmp_path):
    policy = new_policy(recording)
    constants = load_meta(recording)["normalization"]
    normalizer = policy.world_model.dynamics_decoder.normalizers["velocity"]
    assert torch.allclose(normalizer.center + normalizer.scale, torch.tensor(constants["velocity"]["high"]))
    policy.save_pretrained(tmp_path)
    loaded = DynmapPolicy.from_pretrained(tmp_path, strict=True)  # without the dataset
    assert fingerprint(loaded) == fingerprint(policy)
    assert dataclasses.replace(loaded.config) == dataclasses.replace(policy.config)
    with pytest.raises(ValueError, match="without dataset_meta"):
        loaded(load_windows(recording, policy, [0]))


def test_recurrent_control_is_that_of_our_actor_and_forgets_at_a_reset(recording):
    policy = new_policy(recording)
    episode = load_dataset(recording)[:2, :5]
    actor = modules.Actor(policy.world_model, policy.policy, mixed=True)

    def act():
        actions = []
        for t in range(5):
            frames = episode["pixels"][:, t] / 255
            batch = {"observation.images.front": frames, "observation.state": episode["agent_pos"][:, t]}
            actions.append(policy.select_action(batch))
        return torch.stack(actions, 1)

    memory, expected = TensorDict({}, [2]), []
    with torch.no_grad():
        for t in range(5):
            step = actor(episode[:, t].select("pixels", "goal").update(memory))
            expected.append(step["action"])
            memory = step["next"]
    first = act()
    assert torch.equal(first, torch.stack(expected, 1))
    assert not torch.equal(act(), first)
    policy.reset()
    assert torch.equal(act(), first)


def test_settings_that_cannot_be_are_refused(recording):
    for settings, message in (
        ({"supervision": "speed"}, "unknown supervision"),
        ({"kind": "transformer"}, "unknown policy"),
        ({"window_steps": 1}, "at least 2"),
    ):
        with pytest.raises(ValueError, match=message):
            DynmapConfig(**(SMALL | settings))
    config = DynmapConfig(**SMALL)
    with pytest.raises(ValueError, match="one camera"):
        DynmapPolicy(config)
    info = json.loads((recording / "meta/info.json").read_text())
    assert info["fps"] == DynmapEnvConfig().fps
