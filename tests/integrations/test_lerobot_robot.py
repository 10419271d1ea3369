"""The environments as a robot of LeRobot, and its asynchronous inference on loopback."""

import importlib
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from lerobot.robots import make_robot_from_config
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.integrations.lerobot import DynmapRobotConfig, robot

ACTIONS = 0.002 * np.random.default_rng(0).uniform(-1, 1, (130, 3)).astype(np.float32)


@pytest.fixture
def played(tmp_path, monkeypatch):
    """Return a robot, and its clock, which stands still."""
    clock = [0.0]
    monkeypatch.setattr(robot.time, "perf_counter", lambda: clock[0])
    made = make_robot_from_config(DynmapRobotConfig(scene=3, calibration_dir=tmp_path))
    made.connect()
    yield made, clock
    made.disconnect()


def reference(actions):
    """Return observations and the last info of the same scene in Gymnasium."""
    env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels_agent_pos", disable_env_checker=True)
    seen, info = [env.reset(seed=scene_seed("test", 3))[0]], {}
    for action in actions:
        observation, _, terminated, truncated, info = env.step(action)
        seen.append(observation)
        if terminated or truncated:
            break
    return seen, info


def send(made, action):
    made.send_action(dict(zip(made.action_features, action.tolist(), strict=True)))


def assert_seen(made, expected, step):
    observation = made.get_observation()
    assert (observation["front"] == expected["pixels"]).all()
    values = [observation[name] for name in robot.STATE]
    assert values == [step, *expected["agent_pos"].tolist()]
    assert set(observation) == set(made.observation_features)


def test_a_robot_sees_the_frame_at_the_beginning_of_its_step(played):
    made, clock = played
    expected, info = reference(ACTIONS)
    clock[0] = 7.0  # nothing moves before the first action
    assert_seen(made, expected[0], 0)
    for t, action in enumerate(ACTIONS):
        send(made, action)
        if t <= 120:
            assert_seen(made, expected[t], t)
        clock[0] += 0.05 + 0.01 * (t % 3 - 1)  # small deviations do not matter
    assert made.over and made.held == 0
    assert made.info == info


def test_a_robot_says_whether_it_is_connected(played, tmp_path):
    made, _ = played
    with pytest.raises(DeviceAlreadyConnectedError):
        made.connect()
    made.disconnect()
    for call in (made.get_observation, lambda: send(made, ACTIONS[0])):
        with pytest.raises(DeviceNotConnectedError):
            call()
    with pytest.raises(ValueError, match="robot.task must be one of balance_reaching"):
        DynmapRobotConfig(task="mujoco:PlateSlide", calibration_dir=tmp_path)


def test_a_robot_holds_its_pose_where_no_action_comes(played):
    made, clock = played
    still = np.zeros(3, np.float32)
    expected, _ = reference([ACTIONS[0], still, still, ACTIONS[1], still])
    send(made, ACTIONS[0])
    clock[0] += 0.15
    assert_seen(made, expected[2], 0)
    send(made, ACTIONS[1])
    assert_seen(made, expected[3], 1)
    clock[0] += 0.1
    assert_seen(made, expected[4], 1)
    assert made.held == 3


@pytest.mark.slow
def test_lerobots_server_and_client_drive_the_task_although_chunks_are_late(tmp_path, monkeypatch):
    pytest.importorskip("grpc", reason="LeRobot's asynchronous inference needs the extra async")
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    monkeypatch.chdir(tmp_path)  # LeRobot writes logs
    asynchronous = importlib.import_module("asynchronous")
    policy = asynchronous.export("balance_reaching", tmp_path, delay=8)
    seen, _ = reference([])
    with asynchronous.serve(0.3, tmp_path) as address:
        row = asynchronous.play(policy, address, scene=3)
    *_, x, y = seen[0]["agent_pos"]
    start = np.hypot(x - seen[0]["agent_pos"][0], y - seen[0]["agent_pos"][1])
    assert row["late"] and row["position_error"] < start / 2
