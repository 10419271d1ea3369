"""The Gymnasium ids in other people's hands: vector environments, windows, wrappers, Stable-Baselines3."""

import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pygame
import pytest
from gymnasium.utils.env_checker import check_env

from dynmap_rl import GYMNASIUM_IDS

every_id = pytest.mark.parametrize("name", GYMNASIUM_IDS)


def make(name="dynmap_rl/BalanceReaching-v0", **arguments) -> gym.Env:
    return gym.make(name, **arguments)


def play(env: gym.vector.VectorEnv, steps: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    high = env.single_action_space.high
    states = [env.reset(seed=[4, 5])[0]]
    actions = rng.uniform(-high, high, (steps, 2, 3)).astype(np.float32)
    states += [env.step(action)[0] for action in actions]
    env.close()
    return states


@pytest.mark.parametrize(
    "imports",
    [
        "import gymnasium, dynmap_rl",
        "import dynmap_rl, sys; assert 'gymnasium' not in sys.modules; import gymnasium",
        "import dynmap_rl, importlib.util; importlib.util.find_spec('gymnasium'); import gymnasium",
        "import dynmap_rl; from gymnasium.envs import registration; import gymnasium",
        "import dynmap_rl, importlib; importlib.reload(dynmap_rl); import gymnasium",
        "import gymnasium; gymnasium.make('dynmap_rl:dynmap_rl/BinDropping-v0')",
    ],
)
def test_the_ids_are_there_whatever_is_imported_first(imports):
    use = "import sys; [gymnasium.make(name) for name in dynmap_rl.GYMNASIUM_IDS]; assert 'dynmap_rl' not in str(sys.meta_path)"
    subprocess.run([sys.executable, "-c", f"{imports}; import dynmap_rl; {use}"], check=True)


def test_the_ids_are_there_when_gymnasium_s_first_import_fails_and_the_next_succeeds():
    script = """
import sys
import dynmap_rl
sys.modules["gymnasium.core"] = None  # cannot be imported
try:
    import gymnasium
except ImportError:
    del sys.modules["gymnasium.core"]
import gymnasium
[gymnasium.make(name) for name in dynmap_rl.GYMNASIUM_IDS]
assert "dynmap_rl" not in str(sys.meta_path)
"""
    subprocess.run([sys.executable, "-c", script], check=True)


@every_id
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


@every_id
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_processes_and_one_process_give_the_same_as_single_environments(name):
    """Past the end of episodes too: each environment draws its next scene from its own seed."""
    arguments = {"num_envs": 2, "obs_type": "pixels_agent_pos"}
    one = play(gym.make_vec(name, vectorization_mode="sync", **arguments), 125)
    many = play(gym.make_vec(name, vectorization_mode="async", **arguments), 125)
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
