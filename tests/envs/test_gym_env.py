"""The Gymnasium ids, used as Gymnasium's users use them."""

import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env

import dynmap_rl  # noqa: F401 (registers the ids)
from dynmap_rl.envs.gym_env import OBS_TYPES, DynmapEnv
from dynmap_rl.envs.task_env import TaskEnv
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, ACTION_LIMIT, EPISODE_STEPS
from dynmap_rl.keys import GYMNASIUM_IDS

STILL = np.zeros(3, dtype=np.float32)
HARD = {"position": ACTION_LIMIT, "acceleration": ACCELERATION_LIMIT}


every_task = pytest.mark.parametrize("task", GYMNASIUM_IDS)


def make(task="balance_reaching", **arguments) -> gym.Env:
    return gym.make(GYMNASIUM_IDS[task], **arguments).unwrapped


def test_every_task_has_its_id():
    assert set(GYMNASIUM_IDS) == set(TASKS)
    assert {name: make(name).task.name for name in GYMNASIUM_IDS} == {name: name for name in GYMNASIUM_IDS}


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
    assert reward < -1
    assert info["dropped"] and not info["is_success"]


@every_task
def test_info_holds_plain_flags(task):
    env = make(task)
    _, info = env.reset(seed=0)
    for values in (info, env.step(STILL)[-1]):
        assert set(values) == {"is_success", "dropped", "touched", "position_error"}
        assert [type(value) for value in values.values()] == [bool, bool, bool, np.float32]
    both = gym.make_vec(env.spec.id, num_envs=2, vectorization_mode="sync")
    _, info = both.reset(seed=0)
    assert info["dropped"].dtype == bool and info["position_error"].dtype == np.float32


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
    vector = gym.make_vec(GYMNASIUM_IDS[task], num_envs=2, vectorization_mode="sync")
    states = [vector.reset(seed=[4, 5])[0]]
    action = np.array([[0.005, 0.002, 0.0], [-0.005, 0.001, 0.01]], dtype=np.float32)
    states += [vector.step(action)[0] for _ in range(10)]
    for i in range(2):
        env = make(task)
        single = [env.reset(seed=4 + i)[0]] + [env.step(action[i])[0] for _ in range(10)]
        np.testing.assert_array_equal(np.array(states)[:, i], single)


@pytest.mark.parametrize("name", ["task", "obs_type", "control", "render_mode"])
def test_unknown_argument_raises(name):
    with pytest.raises(ValueError, match=f"{name} .*'nope'"):
        DynmapEnv(**{name: "nope"})
    with pytest.raises(ValueError, match="render_size must be at least 1 pixel, got 0"):
        DynmapEnv(render_size=0)


@pytest.mark.parametrize("control", ["position", "acceleration"])
@pytest.mark.parametrize("action", [[np.nan, 0, 0], 0.0, [0.0], [0.0, 0.0]])
def test_invalid_action_raises(control, action):
    env = make(control=control)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="3 finite numbers"):
        env.step(np.array(action))


def play_vector(env: gym.vector.VectorEnv, steps: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    high = env.single_action_space.high
    states = [env.reset(seed=[4, 5])[0]]
    actions = rng.uniform(-high, high, (steps, 2, 3)).astype(np.float32)
    states += [env.step(action)[0] for action in actions]
    env.close()
    return states


def test_ids_are_there_after_an_import_and_make_without_torch():
    make = "gymnasium.make('dynmap_rl:dynmap_rl/BinDropping-v1', obs_type='pixels').reset(seed=0)"
    script = f"import gymnasium, sys; {make}; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True)


@pytest.mark.parametrize("name", GYMNASIUM_IDS)
@pytest.mark.parametrize("control", ["position", "acceleration"])
def test_actions_from_minus_one_to_one_by_gymnasium_s_wrapper(name, control):
    """Then there is nothing left to advise, but that it is a wrapper."""
    env = gym.wrappers.RescaleAction(make(name, control=control), np.float32(-1), np.float32(1))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*is different from the unwrapped version")
        check_env(env, skip_render_check=True)
    env.reset(seed=0)
    env.step(np.ones(3, dtype=np.float32))
    plain = make(name, control=control)
    plain.reset(seed=0)
    plain.step(plain.action_space.high)
    np.testing.assert_array_equal(env.unwrapped.world.commanded, plain.unwrapped.world.commanded)


@pytest.mark.slow
@pytest.mark.parametrize("name", GYMNASIUM_IDS)
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_processes_and_one_process_give_the_same_as_single_environments(name):
    """Past the end of episodes too: each environment draws its next scene from its own seed."""
    arguments = {"num_envs": 2, "obs_type": "pixels_agent_pos"}
    one = play_vector(gym.make_vec(GYMNASIUM_IDS[name], vectorization_mode="sync", **arguments), 125)
    many = play_vector(gym.make_vec(GYMNASIUM_IDS[name], vectorization_mode="async", **arguments), 125)
    for a, b in zip(one, many, strict=True):
        np.testing.assert_array_equal(a["pixels"], b["pixels"])
        np.testing.assert_array_equal(a["agent_pos"], b["agent_pos"])
    env = make(name, obs_type="pixels_agent_pos")
    np.testing.assert_array_equal(one[0]["pixels"][1], env.reset(seed=5)[0]["pixels"])


def test_human_mode_shows_every_step_in_a_window():
    env = make(render_mode="human", render_size=128)
    quiet = make(render_mode="rgb_array", render_size=128)
    env.reset(seed=0), quiet.reset(seed=0)
    for _ in range(3):
        shown = pygame.surfarray.array3d(pygame.display.get_surface()).transpose(1, 0, 2)
        np.testing.assert_array_equal(shown, quiet.render())
        action = np.full(3, 0.005, dtype=np.float32)
        env.step(action), quiet.step(action)
    assert env.render() is None
    env.close()
    assert not pygame.display.get_init()
    env.close()


def test_two_windows_do_not_break_each_other():
    first, second = make(render_mode="human", render_size=128), make(render_mode="human", render_size=96)
    first.reset(seed=0), second.reset(seed=1)
    first.step(np.zeros(3, np.float32))
    second.close()
    first.step(np.zeros(3, np.float32))
    first.close()
    assert not pygame.display.get_init()


def test_an_environment_that_has_not_begun_says_so():
    for env in (DynmapEnv(render_mode="rgb_array"), TaskEnv("balance_reaching", render_mode="rgb_array")):
        for call in (env.render, lambda env=env: env.step(np.zeros(3, np.float32))):
            with pytest.raises(gym.error.ResetNeeded, match="reset"):
                call()


@pytest.mark.slow
def test_stable_baselines_trains_on_the_id_out_of_the_box():
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    env = make(control="acceleration")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*recommend you to use a symmetric and normalized Box")
        check_for_sb3(env.unwrapped, skip_render_check=True)
    model = sb3.PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps == 256
    assert all((a != b).any() for a, b in zip(before, model.policy.parameters(), strict=True))
    assert len(model.ep_info_buffer) > 0, "an episode has ended"
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert action in env.action_space
