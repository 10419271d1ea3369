"""The Gymnasium ids, used as Gymnasium's users use them."""

import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import dynmap_rl  # noqa: F401 (registers the ids)
from dynmap_rl.envs.gym_env import OBS_TYPES
from dynmap_rl.envs.gym_env import DynmapEnv
from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import EPISODE_STEPS

IDS = {
    "balance_reaching": "dynmap_rl/BalanceReaching-v0",
    "balance_reaching_obstacle": "dynmap_rl/BalanceReachingObstacle-v0",
    "bin_dropping": "dynmap_rl/BinDropping-v0",
}
STILL = np.zeros(3, dtype=np.float32)
HARD = {"position": [0.02, 0.02, 0.05], "acceleration": [3.0, 3.0, 10.0]}


every_task = pytest.mark.parametrize("task", IDS)


def make(task="balance_reaching", **arguments) -> gym.Env:
    return gym.make(IDS[task], **arguments).unwrapped


def test_every_task_has_its_id():
    assert set(IDS) == set(TASKS)
    assert {name: make(name).task.name for name in IDS} == {name: name for name in IDS}


@every_task
@pytest.mark.parametrize("obs_type", OBS_TYPES)
@pytest.mark.parametrize("control", HARD)
def test_passes_gymnasiums_own_check(task, obs_type, control):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium's advice, not a rule: accelerations are in SI units, as the experts act and TorchRL has them.
        if control == "acceleration":
            warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space")
        check_env(make(task, obs_type=obs_type, control=control, render_mode="rgb_array"))


@pytest.mark.parametrize("control", HARD)
def test_action_space_is_the_carts_limits(control):
    np.testing.assert_allclose(make(control=control).action_space.high, HARD[control])


@every_task
@pytest.mark.parametrize("obs_type", OBS_TYPES)
def test_observations_lie_in_their_space(task, obs_type):
    env = make(task, obs_type=obs_type)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    for _ in range(EPISODE_STEPS):
        assert observation in env.observation_space
        observation, *_ = env.step(env.action_space.sample())


@every_task
def test_agent_pos_is_command_and_goal(task):
    env = make(task, obs_type="pixels_agent_pos")
    observation, _ = env.reset(options={"cart_x": 0.3, "cart_y": 0.2, "goal_x": 0.7, "goal_y": 0.5})
    np.testing.assert_allclose(observation["agent_pos"], [0.3, 0.2, 0.0, 0.7, 0.5], atol=1e-7)
    observation, *_ = env.step(np.array([0.004, 0.002, 0.01]))
    np.testing.assert_allclose(observation["agent_pos"], [0.304, 0.202, 0.01, 0.7, 0.5], atol=1e-7)


@every_task
def test_reset_options_fix_factors_and_leave_the_others_drawn(task):
    env, default = make(task), get_task(task).ranges.scene()
    env.reset(seed=3)
    drawn = env.world.scene
    env.reset(seed=3, options={"cart_x": 0.31, "block_color": [0, 0, 90]})
    assert env.world.scene == drawn.replace(cart_x=0.31, block_color=(0, 0, 90))
    env.reset(options=default.to_dict())
    assert env.world.scene == default
    with pytest.raises(ValueError, match="colour"):
        env.reset(options={"colour": 1})


@every_task
def test_seed_determines_every_scene_that_follows(task):
    def starts(seed):
        env = make(task)
        return [env.reset(seed=seed)[0], env.reset()[0], env.reset()[0]]

    np.testing.assert_array_equal(starts(5), starts(5))
    assert len(np.unique([*starts(5), *starts(6)], axis=0)) == 6


@every_task
def test_seed_and_actions_determine_the_trajectory(task):
    def play(seed):
        env = make(task)
        env.action_space.seed(0)
        start, _ = env.reset(seed=seed)
        return [start] + [env.step(env.action_space.sample())[0] for _ in range(40)]

    np.testing.assert_array_equal(play(2), play(2))
    assert not np.array_equal(play(2), play(3))


@every_task
def test_ranges_are_a_parameter(task):
    env = make(task, ranges=replace(get_task(task).ranges, cart_width=(0.4, 0.5)))
    for seed in range(5):
        env.reset(seed=seed)
        assert 0.4 <= env.world.scene.cart_width <= 0.5


def test_success_is_told_on_the_last_step_only():
    env = make()
    env.reset(seed=0, options={"cart_x": 0.5, "cart_y": 0.5, "goal_x": 0.5, "goal_y": 0.5})
    results = [env.step(STILL)[2:] for _ in range(EPISODE_STEPS)]
    last = [False] * (EPISODE_STEPS - 1) + [True]
    assert [bool(info["is_success"]) for *_, info in results] == last
    assert [truncated for _, truncated, _ in results] == last
    assert not any(terminated for terminated, *_ in results)


def test_drop_terminates_without_success():
    env = make(control="acceleration")
    env.reset(seed=0, options={"block_height": 0.2, "cart_x": 0.5, "goal_x": 0.5})
    for i in range(EPISODE_STEPS):
        action = np.array([3.0 if i // 4 % 2 else -3.0, 0.0, 0.0])
        _, reward, terminated, truncated, info = env.step(action)
        if terminated:
            break
    assert terminated and not truncated
    assert reward == 0
    assert info["dropped"] and not info["is_success"]


@every_task
def test_info_holds_numpy_scalars(task):
    env = make(task)
    _, info = env.reset(seed=0)
    for values in (info, env.step(STILL)[-1]):
        assert set(values) == {"is_success", "dropped", "touched", "position_error"}
        assert all(isinstance(value, np.generic) for value in values.values())


@every_task
def test_render_has_the_size_asked_for_and_shows_the_observed_scene(task):
    env = make(task, obs_type="pixels", render_mode="rgb_array", render_size=96)
    observation, _ = env.reset(seed=0)
    assert env.render().shape == (96, 96, 3)
    assert env.render().flags.writeable and observation.flags.writeable
    same_size = make(task, obs_type="pixels", render_mode="rgb_array", render_size=64)
    same_size.reset(seed=0)
    np.testing.assert_array_equal(same_size.render(), observation)


@every_task
def test_vector_environment_equals_single_ones(task):
    vector = gym.make_vec(IDS[task], num_envs=2, vectorization_mode="sync")
    states = [vector.reset(seed=[4, 5])[0]]
    action = np.array([[0.005, 0.002, 0.0], [-0.005, 0.001, 0.01]], dtype=np.float32)
    states += [vector.step(action)[0] for _ in range(10)]
    for i in range(2):
        env = make(task)
        single = [env.reset(seed=4 + i)[0]] + [env.step(action[i])[0] for _ in range(10)]
        np.testing.assert_array_equal(np.array(states)[:, i], single)


@pytest.mark.parametrize("name", ["task", "obs_type", "control", "render_mode"])
def test_unknown_argument_raises(name):
    with pytest.raises(ValueError, match=f"unknown {name} 'nope'"):
        DynmapEnv(**{name: "nope"})


def test_invalid_action_raises():
    env = make()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="3 finite numbers"):
        env.step(np.array([np.nan, 0, 0]))
