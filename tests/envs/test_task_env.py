"""Any task as a Gymnasium environment: spaces, seeds, success, and agreement with the TorchRL environment."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from own_task import own_task  # noqa: F401
from point_task import Point

from dynmap_rl.envs.task_env import TaskEnv
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.keys import GYMNASIUM_TASK


@pytest.mark.filterwarnings("ignore:.*infinity:UserWarning")
@pytest.mark.filterwarnings("ignore:.*A Box observation space:UserWarning")
def test_it_fits_gymnasium(own_task):  # noqa: F811
    check_env(TaskEnv(f"{own_task}:cameras=2"), skip_render_check=True)


@pytest.mark.parametrize("flat", [False, True])
def test_episodes_are_those_of_the_torchrl_environment(own_task, flat):  # noqa: F811
    name = "balance_reaching" if flat else f"{own_task}:cameras=2"
    env = gymnasium.make(GYMNASIUM_TASK, task=name, disable_env_checker=True)
    batched = DynmapBatchedEnv(name, 1, from_pixels=True)
    td, (observation, _) = batched.reset(scene_seed=torch.tensor([5])), env.reset(seed=5)
    for t in range(8):
        frames = np.concatenate(list(observation["pixels"].values()), 1)
        assert (frames == td["pixels"][0].permute(1, 2, 0).numpy()).all()
        assert (observation["agent_pos"] == td["agent_pos"][0].numpy()).all()
        action = 0.5 * batched.action_spec.high * (t > 2)
        td = batched.step(td.set("action", action))["next"]
        observation, reward, *_ = env.step(action[0].numpy())
        assert reward == pytest.approx(td["reward"].item(), abs=1e-6)


def test_success_is_reported_in_the_last_step_alone(own_task):  # noqa: F811
    env = TaskEnv(own_task, render_mode="rgb_array")
    env.reset(seed=0)
    act, ends = get_task(own_task).demonstrator(env.world), []
    for _ in range(env._max_episode_steps):
        *_, terminated, truncated, info = env.step(act())
        ends.append((terminated, truncated, bool(info["is_success"])))
    assert ends[-1] == (False, True, True) and set(ends[:-1]) == {(False, False, False)}
    assert env.render().shape == (256, 256, 3) and env.metadata["render_fps"] == 20
    with pytest.raises(ValueError, match="render_mode"):
        TaskEnv(own_task, render_mode="human")


def test_options_that_would_have_no_effect_are_refused():
    with pytest.raises(ValueError, match="goal_x"):
        TaskEnv("balance_reaching").reset(seed=0, options={"goal_x": 0.7})


def test_an_action_of_another_shape_is_refused():
    env = TaskEnv("balance_reaching")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"\(3,\), got \(2,\)"):
        env.step(np.zeros(2, np.float32))


def test_frames_are_copies_of_the_layout_s_form(monkeypatch):
    picture = np.zeros((64, 64, 3), np.uint8)

    def draw(world):
        picture[:] = world.steps
        return picture

    monkeypatch.setattr(Point, "make_renderer", lambda task: draw)
    env = TaskEnv("point_task:Point")
    first = env.reset(seed=0)[0]["pixels"]["front"]
    env.step(np.zeros(2))
    assert (first == 0).all() and (picture == 1).all()
    monkeypatch.setattr(Point, "make_renderer", lambda task: lambda world: np.zeros((32, 64, 3)))
    with pytest.raises(ValueError, match="frame of the task point"):
        TaskEnv("point_task:Point").reset(seed=0)


def test_closing_closes_the_simulator(own_task, monkeypatch):  # noqa: F811
    env, closed = TaskEnv(own_task), []
    env.reset(seed=0)
    monkeypatch.setattr(env.world.env, "close", lambda: closed.append(True))
    env.close(), env.close()
    assert closed == [True]
    env.reset(seed=0)
