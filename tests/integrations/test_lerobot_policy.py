"""The LeRobot policy ``dynmap``: windows, losses, constants, control."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import make_policy, make_policy_config, make_pre_post_processors
from robot_dataset import CAMERA, make_robot_dataset
from tensordict import TensorDict

from dynmap_rl.data import add_dynamics
from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.integrations.lerobot.configuration_dynmap import DynmapConfig
from dynmap_rl.integrations.lerobot.modeling_dynmap import DynmapPolicy
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.chunk_actor import ChunkActor
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.utils.weights import fingerprint

SMALL = {"device": "cpu", "push_to_hub": False, "window_steps": 6, "rgb_frames": 2}


def load_windows(recording, policy, starts, episodes=None):
    """Return a batch of LeRobot's loader and preprocessor: windows that begin at these frames."""
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
    policy, episodes = new_policy(recording), load_dataset(recording)
    pushed = int(episodes["disturbed"][1].flatten().int().argmax())  # in the first step of the second window
    batch = load_windows(
        recording, policy, [0, 120 + pushed, 237]
    )  # the last goes 3 steps beyond its episode
    windows = policy.make_windows(batch)
    assert windows.shape == (3, 6) and windows["disturbed"][1, 0]
    for row, episode, steps in (
        (0, 0, range(6)),
        (1, 1, range(pushed, pushed + 6)),
        (2, 1, [117, 118, 119, 119, 119, 119]),
    ):
        expected = episodes[episode][list(steps)]
        for key in ("pixels", "action", "expert_action", "goal", "dynamics", "step_count"):
            assert (windows[row][key] == expected[key]).all(), key
        assert torch.equal(windows["disturbed"][row], expected["disturbed"])
        there = [row != 2 or step < 3 for step in range(6)]
        assert windows["collector", "mask"][row].tolist() == there


def test_weights_of_imagenet_are_loaded_where_a_training_begins_alone(recording, tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr("dynmap_rl.integrations.lerobot.modeling_dynmap.load_imagenet", loaded.append)
    policy = new_policy(recording, architecture="resnet18_imagenet")
    assert loaded == [policy.world_model.encoder]
    policy.save_pretrained(tmp_path)
    new_policy(recording, architecture="resnet18_imagenet", pretrained_path=tmp_path)
    assert len(loaded) == 1


def test_what_was_not_found_in_the_frames_is_not_labelled(recording, tmp_path):
    root = tmp_path / "tracks"
    add_dynamics(recording, root, source="tracks", replace=True)
    policy, episodes = new_policy(root), load_dataset(root)
    windows = policy.make_windows(load_windows(root, policy, [0, 125]))
    for row, expected in enumerate((episodes[0, :6], episodes[1, 5:11])):
        assert torch.equal(windows["labelled"][row], expected["labelled"])


def test_a_part_from_the_middle_has_its_own_dynamics(recording, tmp_path):
    """LeRobot may have downloaded the files of some episodes only."""
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
    with pytest.raises(ValueError, match="index"):
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


def test_whether_a_task_that_is_not_imported_is_symmetric_must_be_said(recording, tmp_path):
    own = shutil.copytree(recording, tmp_path / "own")
    path = own / "meta/dynmap.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"task": "my_tasks:Lift"}))
    with pytest.raises(ValueError, match="--policy.symmetric"):
        new_policy(own)
    assert new_policy(own, symmetric=True).symmetric


@pytest.mark.parametrize("recolor", [False, True])
@pytest.mark.parametrize("symmetric", [False, True])
def test_windows_of_a_symmetric_scene_are_mirrored_and_shifted(recording, symmetric, recolor):
    policy = new_policy(recording, symmetric=symmetric, recolor=recolor)
    windows = policy.make_windows(load_windows(recording, policy, range(0, 80, 10)))
    torch.manual_seed(0)
    changed = policy._augment(windows)
    assert torch.equal(changed["pixels"], windows["pixels"]) is not (symmetric or recolor)
    mirrored = (changed["action"] != windows["action"]).any((1, 2))
    shifted = (changed["goal"][..., 1] != windows["goal"][..., 1]).any(1)
    assert mirrored.any() == shifted.any() == symmetric


def test_constants_are_those_of_the_recording_and_are_saved(recording, tmp_path):
    policy = new_policy(recording)
    constants = load_meta(recording)["normalization"]
    normalizer = policy.world_model.dynamics_decoder.normalizers["velocity"]
    assert torch.allclose(normalizer.center + normalizer.scale, torch.tensor(constants["velocity"]["high"]))
    policy.save_pretrained(tmp_path)
    loaded = DynmapPolicy.from_pretrained(tmp_path, strict=True)  # without the dataset
    assert fingerprint(loaded) == fingerprint(policy)
    assert dataclasses.replace(loaded.config) == dataclasses.replace(policy.config)
    with pytest.raises(ValueError, match="dataset_meta"):
        loaded(load_windows(recording, policy, [0]))


@pytest.mark.parametrize("kind", ["recurrent", "feedforward"])
@torch.no_grad()
def test_actions_are_the_actors_step_by_step_and_again_after_a_reset(recording, kind):
    policy = new_policy(recording, kind=kind)
    episode = load_dataset(recording)[:2, :5]
    actor = Actor(policy.world_model, policy.policy, mixed=True)
    memory, expected = TensorDict({}, [2]), []
    for t in range(5):
        td = actor(episode[:, t].select("pixels", "goal").update(memory))
        expected.append(td["action"])
        memory = td["next"]

    def act():
        actions = []
        for t in range(5):
            frames = episode["pixels"][:, t] / 255
            batch = {"observation.images.front": frames, "observation.state": episode["agent_pos"][:, t]}
            actions.append(policy.select_action(batch))
        return torch.stack(actions, 1)

    assert torch.equal(act(), torch.stack(expected, 1))
    assert not torch.equal(act()[:, 0], expected[0]), "the memory is kept until a reset"
    policy.reset()
    assert torch.equal(act(), torch.stack(expected, 1))


@pytest.mark.parametrize("kind", ["recurrent", "feedforward"])
@torch.no_grad()
def test_late_frames_and_chunks(recording, kind, tmp_path):
    new_policy(recording, kind=kind, delay=2, chunk_size=6).save_pretrained(tmp_path)
    policy = DynmapPolicy.from_pretrained(tmp_path, strict=True)
    episode = load_dataset(recording)[:2, :6]
    actor = Actor(policy.world_model, policy.policy, mixed=True).eval()

    def frames(t, *step):
        numbers = torch.tensor(step).float().expand(2, -1)
        state = torch.cat([numbers, episode["agent_pos"][:, t]], 1)
        return {"observation.images.front": episode["pixels"][:, t] / 255, "observation.state": state}

    delayed, memory = DelayedActor(actor, delay=2), TensorDict({}, [2])
    for t in range(6):
        td = delayed(episode[:, max(t - 2, 0)].select("pixels", "goal").update(memory))
        memory = td["next"]
        assert torch.equal(policy.select_action(frames(max(t - 2, 0))), td["action"])

    chunks = ChunkActor(actor, 6, delay=2)
    for t in (0, 3, 5):
        expected = chunks.act(episode["pixels"][:, t], episode["goal"][:, t], t)
        assert torch.equal(policy.predict_action_chunk(frames(t, t)), expected)
    mixed = frames(0, 0)
    mixed["observation.state"][1, 0] = 7
    with pytest.raises(ValueError, match="one step"):
        policy.predict_action_chunk(mixed)
    policy.reset(), chunks.reset()
    for t in (0, 1):  # without the number of the step
        expected = chunks.act(episode["pixels"][:, t], episode["goal"][:, t])
        assert torch.equal(policy.predict_action_chunk(frames(t)), expected)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"supervision": "speed"}, "speed"),
        ({"kind": "transformer"}, "transformer"),
        ({"architecture": "mlp"}, "architecture must be one of .*glimpse.*'mlp'"),
        ({"window_steps": 1}, "window_steps"),
        ({"supervision": "none", "beta_dynamics": 2.0}, "beta_dynamics has no effect"),
        ({"delay": 20}, "delay"),
        ({"delay": -1}, "delay"),
        ({"rgb_frames": 0}, "rgb_frames must be at least 1"),
        ({"latent_size": 0}, "latent_size"),
        ({"hidden_size": -3}, "hidden_size"),
        ({"width": -4}, "width"),
        ({"optimizer_lr": -1.0}, "optimizer_lr"),
        ({"rarity": -1.0}, "rarity"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        DynmapConfig(**(SMALL | settings))


def test_missing_features_are_refused():
    with pytest.raises(ValueError, match="camera"):
        DynmapPolicy(DynmapConfig(**SMALL))


def test_a_robot_dataset_is_sent_to_its_own_recipe(tmp_path):
    add_dynamics(make_robot_dataset(tmp_path / "robot", (12, 12)), tmp_path / "mine", columns=[0, 1])
    frame, state, action = (
        PolicyFeature(FeatureType[kind], shape)
        for kind, shape in (("VISUAL", (3, 64, 64)), ("STATE", (4,)), ("ACTION", (2,)))
    )
    features = {
        "input_features": {CAMERA: frame, "observation.state": state},
        "output_features": {"action": action},
    }
    with pytest.raises(ValueError, match=r"mine must be a recording.*got 2; .*robot\.py"):
        DynmapPolicy(DynmapConfig(**SMALL, **features), dataset_meta=SimpleNamespace(root=tmp_path / "mine"))
