"""The Gymnasium ids, used as Gymnasium's users use them."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import dynmap_rl  # noqa: F401 (registers the ids)
from dynmap_rl.envs.gymnasium_env import OBS_TYPES, DynmapEnv
from dynmap_rl.envs.scene import Scene, SceneRanges
from dynmap_rl.envs.world import EPISODE_STEPS

ID = "dynmap_rl/BalanceReaching-v0"
STILL = np.zeros(3, dtype=np.float32)
HARD = {"position": [0.02, 0.02, 0.05], "acceleration": [3.0, 3.0, 10.0]}


def make(**arguments) -> gym.Env:
    return gym.make(ID, **arguments).unwrapped


@pytest.mark.parametrize("obs_type", OBS_TYPES)
@pytest.mark.parametrize("control", HARD)
def test_passes_gymnasiums_own_check(obs_type, control):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if control == "acceleration":  # in SI units, as the experts act, not scaled to [-1, 1]
            warnings.filterwarnings("ignore", message=".*recommend using a symmetric and normalized space")
        check_env(make(obs_type=obs_type, control=control, render_mode="rgb_array"))


@pytest.mark.parametrize("control", HARD)
def test_action_space_is_the_carts_limits(control):
    np.testing.assert_allclose(make(control=control).action_space.high, HARD[control])


@pytest.mark.parametrize("obs_type", OBS_TYPES)
def test_observations_lie_in_their_space(obs_type):
    env = make(obs_type=obs_type)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    for _ in range(EPISODE_STEPS):
        assert observation in env.observation_space
        observation, *_ = env.step(env.action_space.sample())


def test_agent_pos_is_command_and_goal():
    env = make(obs_type="pixels_agent_pos")
    observation, _ = env.reset(options={"cart_x": 0.3, "cart_y": 0.2, "goal_x": 0.7, "goal_y": 0.5})
    np.testing.assert_allclose(observation["agent_pos"], [0.3, 0.2, 0.0, 0.7, 0.5], atol=1e-7)
    observation, *_ = env.step(np.array([0.004, 0.002, 0.01]))
    np.testing.assert_allclose(observation["agent_pos"], [0.304, 0.202, 0.01, 0.7, 0.5], atol=1e-7)


def test_reset_options_fix_factors_and_leave_the_others_drawn():
    env = make()
    env.reset(seed=3)
    drawn = env.world.scene
    env.reset(seed=3, options={"cart_x": 0.31, "block_color": [0, 0, 90]})
    assert env.world.scene == drawn.replace(cart_x=0.31, block_color=(0, 0, 90))
    env.reset(options=Scene().to_dict())
    assert env.world.scene == Scene()
    with pytest.raises(ValueError, match="colour"):
        env.reset(options={"colour": 1})


def test_seed_determines_every_scene_that_follows():
    def starts(seed):
        env = make()
        return [env.reset(seed=seed)[0], env.reset()[0], env.reset()[0]]

    np.testing.assert_array_equal(starts(5), starts(5))
    assert len(np.unique([*starts(5), *starts(6)], axis=0)) == 6


def test_ranges_are_a_parameter():
    env = make(ranges=SceneRanges(cart_width=(0.4, 0.5)))
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


def test_info_holds_numpy_scalars():
    env = make()
    _, info = env.reset(seed=0)
    for values in (info, env.step(STILL)[-1]):
        assert set(values) == {"is_success", "dropped", "position_error"}
        assert all(isinstance(value, np.generic) for value in values.values())


def test_render_has_the_size_asked_for_and_shows_the_observed_scene():
    env = make(obs_type="pixels", render_mode="rgb_array", render_size=96)
    observation, _ = env.reset(seed=0)
    assert env.render().shape == (96, 96, 3)
    assert env.render().flags.writeable and observation.flags.writeable
    same_size = make(obs_type="pixels", render_mode="rgb_array", render_size=64)
    same_size.reset(seed=0)
    np.testing.assert_array_equal(same_size.render(), observation)


def test_vector_environment_equals_single_ones():
    vector = gym.make_vec(ID, num_envs=2, vectorization_mode="sync")
    states = [vector.reset(seed=[4, 5])[0]]
    action = np.array([[0.005, 0.002, 0.0], [-0.005, 0.001, 0.01]], dtype=np.float32)
    states += [vector.step(action)[0] for _ in range(10)]
    for i in range(2):
        env = make()
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
