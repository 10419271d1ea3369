"""Late frames in TorchRL: specs, rollouts, resets, and the same delays as in Gymnasium."""

from dataclasses import replace

import gymnasium as gym
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymWrapper, ParallelEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

import dynmap_rl  # noqa: F401 (registers the tasks)
from dynmap_rl.envs.delay import DelayFrames, FrameDelay
from dynmap_rl.envs.delay_transform import DelayTransform
from dynmap_rl.envs.task import LAYOUT, Task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv

DELAY = FrameDelay(3, 2, 0.2)
SEEDS = torch.tensor([4, 5, 6])
both_forms = pytest.mark.parametrize("bursts", [False, True])


def make_env(delay=DELAY, num_envs=3, seed=0, **arguments):
    env = DynmapBatchedEnv(num_envs=num_envs, from_pixels=True, seed=0)
    return TransformedEnv(env, DelayTransform(delay, seed, **arguments))


def make_actions(steps):
    return 0.02 * torch.rand(3, steps, 3, generator=torch.Generator().manual_seed(0)) - 0.01


def play(env, steps=20):
    """Return pixels and delays of the steps of three worlds."""
    td, rows = env.reset(scene_seed=SEEDS), []
    for action in make_actions(steps).unbind(1):
        rows.append(td.select("pixels", "delay", strict=False))
        td = env.step(td.set("action", action))["next"]
    return torch.stack(rows, 1)


@both_forms
@pytest.mark.parametrize("delay", [FrameDelay(), FrameDelay(2), DELAY], ids=str)
def test_specs(delay, bursts):
    env = make_env(delay, bursts=bursts)
    check_env_specs(env)
    td = env.rollout(3)
    places = (2 * delay.jitter + 1,) if bursts else ()
    assert td["pixels"].shape == (3, 3, *places, 3, 64, 64)
    assert td["delay"].shape == (3, 3, *(places or (1,)))


def test_a_used_transform_serves_an_environment_of_another_size():
    used = make_env()
    used.rollout(3)
    fewer = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    again = TransformedEnv(fewer, used.transform.clone()).rollout(5)
    assert torch.equal(again["delay"], make_env(num_envs=2).rollout(5)["delay"])


def test_a_clone_has_frames_of_its_own():
    used, other = make_env(), DynmapBatchedEnv(num_envs=3, from_pixels=True, seed=1)
    td = used.reset(scene_seed=SEEDS)
    other = TransformedEnv(other, used.transform.clone())
    rows, of_other = [], other.reset(scene_seed=SEEDS + 9)
    for action in make_actions(8).unbind(1):
        rows.append(td.select("pixels", "delay"))
        of_other = other.step(of_other.set("action", -action))["next"]
        td = used.step(td.set("action", action))["next"]
    alone = play(make_env(), 8)
    assert all(torch.equal(torch.stack(rows, 1)[key], alone[key]) for key in ("pixels", "delay"))


def test_a_number_is_no_delay():
    with pytest.raises(ValueError, match="FrameDelay"):
        DelayTransform(6)


def test_frames_are_those_of_the_steps_that_the_delays_name():
    on_time = play(DynmapBatchedEnv(num_envs=3, from_pixels=True))["pixels"]
    newest, bursts = play(make_env()), play(make_env(bursts=True))
    for world in range(3):
        last = 0
        for t in range(20):
            delays, frames = bursts["delay"][world, t], bursts["pixels"][world, t]
            arrived = [t - d for d in delays.tolist() if d >= 0]
            assert arrived == sorted(set(arrived), reverse=True)
            assert [d for d in delays.tolist() if d < 0] == [-1] * (5 - len(arrived))
            assert (frames[len(arrived) :] == 0).all()
            assert torch.equal(frames[: len(arrived)], on_time[world][arrived])
            last = max([last, *arrived])
            assert newest["delay"][world, t].item() == t - last
            assert torch.equal(newest["pixels"][world, t], on_time[world, last])


@pytest.mark.parametrize("error", [0, 3])
def test_delays_equal_those_of_the_gymnasium_wrapper(error):
    delay = replace(DELAY, error=error)
    late = play(make_env(delay, seed=SEEDS.tolist()))
    for world, seed in enumerate(SEEDS.tolist()):
        env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels", disable_env_checker=True)
        env = DelayFrames(env, delay)
        frame, info = env.reset(seed=seed)
        for t, action in enumerate(make_actions(20)[world]):
            assert info["delay"] == late["delay"][world, t].item()
            assert torch.equal(torch.from_numpy(frame).permute(2, 0, 1), late["pixels"][world, t])
            frame, _, _, _, info = env.step(action.numpy())


def test_seeds():
    first, again, other = (play(make_env(seed=seed))["delay"] for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert not torch.equal(first[0], first[1])
    alone = make_env(num_envs=1, seed=[6])
    td, row = alone.reset(scene_seed=SEEDS[2:]), []
    for _ in range(20):
        row.append(td["delay"][0])
        td = alone.step(td.set("action", torch.zeros(1, 3)))["next"]
    assert torch.equal(torch.stack(row), play(make_env(seed=SEEDS.tolist()))["delay"][2])
    with pytest.raises(ValueError, match="one seed for each of 3 worlds, got 2"):
        make_env(seed=[1, 2]).reset()


@both_forms
def test_a_partial_reset_does_not_change_how_frames_of_other_worlds_arrive(bursts):
    delay, found = FrameDelay(4, 2, 0.2, error=3), []
    for reset in (False, True):
        env, rows = make_env(delay, bursts=bursts), []
        td = env.rollout(6, lambda td: td.set("action", torch.zeros(3, 3)))[:, -1]["next"].exclude("reward")
        if reset:
            td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False]])))
        for action in make_actions(12).unbind(1):
            td = env.step(td.set("action", action))["next"]
            rows.append(td.select("pixels", "delay")[[0, 2]])
        found.append(torch.stack(rows, 1))
    assert torch.equal(found[0]["delay"], found[1]["delay"])
    assert torch.equal(found[0]["pixels"], found[1]["pixels"])


@both_forms
def test_a_partial_reset_leaves_the_other_worlds_as_they_are(bursts):
    env = make_env(bursts=bursts)
    before = env.rollout(6)[:, -1]["next"].exclude("reward")
    after = env.reset(before.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    for key in ("pixels", "delay"):
        assert torch.equal(after[key][[0, 2]], before[key][[0, 2]])
    assert after["delay"][1].tolist() == ([0] + [-1] * 4 if bursts else [0])
    frame = env.base_env._observation["pixels"][1]
    assert torch.equal(after["pixels"][1, 0] if bursts else after["pixels"][1], frame)
    # No frame of the episode before arrives in the new one.
    td = after
    for t in range(1, 12):
        td = env.step(td.set("action", torch.zeros(3, 3)))["next"]
        assert (td["delay"][1] <= t).all()


def test_each_episode_of_a_long_rollout_begins_with_its_own_first_frame(monkeypatch):
    monkeypatch.setattr(Task, "layout", replace(LAYOUT, steps=7))
    env = make_env(FrameDelay(4))
    out = env.rollout(14, lambda td: td.set("action", torch.zeros(3, 3)), break_when_any_done=False)
    assert out["delay"][0].flatten().tolist() == [0, 1, 2, 3, 4, 4, 4] * 2
    assert torch.equal(out["pixels"][:, 7], out["pixels"][:, 10])
    assert not torch.equal(out["pixels"][:, 6], out["pixels"][:, 7])


def test_without_delay_every_episode_begins_with_its_own_first_frame():
    env = make_env(FrameDelay())
    env.rollout(3)
    assert torch.equal(env.reset()["pixels"], env.base_env._observation["pixels"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_around_environments_in_processes_of_their_own():
    env = ParallelEnv(2, lambda: DynmapBatchedEnv(num_envs=3, from_pixels=True), mp_start_method="fork")
    try:
        env = TransformedEnv(env, DelayTransform(FrameDelay(2), seed=0))
        check_env_specs(env)
        assert env.rollout(4)["delay"][1, 2].flatten().tolist() == [0, 1, 2, 2]
        env.reset(TensorDict({"_reset": torch.ones(2, 3, 1, dtype=torch.bool)}, [2, 3]))
    finally:
        env.close()


def test_an_environment_without_batch_dimensions_is_one_world():
    env = GymWrapper(gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels"))
    late = TransformedEnv(env, DelayTransform(FrameDelay(2), seed=0))
    frames = late.rollout(5)
    assert frames["delay"].flatten().tolist() == [0, 1, 2, 2, 2]
    assert frames["pixels"].shape == (5, 64, 64, 3) and torch.equal(frames["pixels"][1], frames["pixels"][0])


def test_an_environment_without_frames_is_refused():
    with pytest.raises(ValueError, match="from_pixels=True"):
        TransformedEnv(DynmapBatchedEnv(), DelayTransform(FrameDelay(6))).rollout(2)
