"""Late frames in Gymnasium: what arrives when, seeds, specs, and the robot's actor on them."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import DictInfoToList
from hypothesis import given
from hypothesis import strategies as st
from small import CONSTANTS, make_model

import dynmap_rl  # noqa: F401 (registers the tasks)
from dynmap_rl.envs.delay import DelayFrames, FrameDelay, make_generator
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.modules.robot_actor import RobotActor

STEPS = 30


class Counter(gym.Env):
    """Environment whose frame is the number of the step."""

    observation_space = gym.spaces.Box(0, 1000, (1,), np.int64)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.array([0]), {}

    def step(self, action):
        self.count += 1
        return np.array([self.count]), 0.0, False, False, {}


def test_an_environment_may_use_its_buffer_again():
    class Buffered(Counter):
        def reset(self, **arguments):
            self.buffer, _ = super().reset(**arguments)
            return self.buffer, {}

        def step(self, action):
            self.buffer[:] = super().step(action)[0]
            return self.buffer, 0.0, False, False, {}

    env = DelayFrames(Buffered(), FrameDelay(2))
    env.reset(seed=0)
    assert [env.step(0)[0].item() for _ in range(4)] == [0, 0, 1, 2]


def test_a_caller_may_change_the_frames_that_arrive():
    env = DelayFrames(Counter(), FrameDelay(3))
    _, info = env.reset(seed=0)
    [(_, frame)] = info["arrived"]
    frame[:] = 99
    assert env.step(0)[0].item() == 0


def test_a_vector_of_environments_lists_what_arrives():
    env = DictInfoToList(gym.vector.SyncVectorEnv([lambda: DelayFrames(Counter(), FrameDelay(1))] * 2))
    env.reset(seed=0)
    for t in range(3):
        *_, infos = env.step(np.zeros(2, int))
        taken = [[(age, int(frame[0])) for age, frame in info["arrived"]] for info in infos]
        assert taken == [[(1, t)] if t else []] * 2


def test_the_wrapper_needs_a_delay_and_a_frame():
    with pytest.raises(ValueError, match="FrameDelay"):
        DelayFrames(Counter(), 6)
    env = Counter()
    env.observation_space = gym.spaces.Dict(frame=Counter.observation_space)
    with pytest.raises(ValueError, match="one of frame, got 'pixels'"):
        DelayFrames(env, FrameDelay(6))


def play(delay, seed=0):
    """Return, for each step, the frame in the observation, its delay, and the frames that arrive by their delay."""
    env = DelayFrames(Counter(), delay)
    rows = [env.reset(seed=seed)]
    rows += [(step[0], step[4]) for step in (env.step(0) for _ in range(STEPS))]
    return [
        (int(frame[0]), int(info["delay"]), {k: int(v[0]) for k, v in info["arrived"]})
        for frame, info in rows
    ]


delays = st.builds(
    lambda steps, jitter, lost: FrameDelay(steps, min(jitter, steps), lost),
    st.integers(0, 8),
    st.integers(0, 8),
    st.sampled_from([0.0, 0.3, 1.0]),
)


@given(delay=delays, seed=st.integers(0, 100))
def test_every_frame_arrives_once_within_its_delay_or_is_lost(delay, seed):
    seen, newest = [], 0
    for t, (frame, age, arrived) in enumerate(play(delay, seed)):
        assert all(t - age == taken for age, taken in arrived.items())
        assert all(abs(age - delay.steps) <= delay.jitter for age in arrived) or t == 0
        seen += arrived.values()
        newest = max([newest, *arrived.values()])
        assert (frame, age) == (newest, t - newest)
    assert seen[0] == 0 and len(set(seen)) == len(seen)
    if delay.lost in (0, 1):
        sure = STEPS + 1 - delay.longest
        assert set(seen) >= set(range(sure if delay.lost == 0 else 1))
        assert delay.lost == 0 or seen == [0]


def test_a_constant_delay_and_none():
    assert [row[0] for row in play(FrameDelay())] == list(range(STEPS + 1))
    assert [row[0] for row in play(FrameDelay(4))] == [0] * 5 + list(range(1, STEPS - 3))
    assert [row[1] for row in play(FrameDelay(4))] == [0, 1, 2, 3] + [4] * (STEPS - 3)


@pytest.mark.parametrize("error", [-3, 2])
def test_a_wrong_clock_changes_the_reported_delays_alone(error):
    right, wrong = play(FrameDelay(4, 1, 0.2), seed=5), play(FrameDelay(4, 1, 0.2, error), seed=5)
    for t, ((frame, age, arrived), (same, reported, elsewhere)) in enumerate(zip(right, wrong, strict=True)):
        assert frame == same and list(arrived.values()) == list(elsewhere.values())
        assert reported == age + (error if age < t else 0)
        assert list(elsewhere) == [age + (error if age < t else 0) for age in arrived]
    assert [FrameDelay(4, 1, error=error).longest for error in (-2, 0, 3)] == [5, 5, 8], "true or reported"
    with pytest.raises(ValueError, match="error must be at least -3"):
        FrameDelay(4, 1, error=-4)


def test_rates_are_those_of_the_settings():
    generator, delay = make_generator(0), FrameDelay(6, 2, 0.1)
    draws = [delay.draw(generator) for _ in range(5000)]
    assert 0.08 < draws.count(None) / 5000 < 0.12
    counts = [draws.count(d) for d in range(4, 9)]
    assert sum(counts) + draws.count(None) == 5000 and min(counts) > 800


def test_lost_frames_do_not_change_the_delays_of_the_others():
    plain, lossy = (
        [delay.draw(generator) for _ in range(50)]
        for delay, generator in (
            (FrameDelay(4, 3), make_generator(0)),
            (FrameDelay(4, 3, 0.3), make_generator(0)),
        )
    )
    assert None in lossy and all(b in (a, None) for a, b in zip(plain, lossy, strict=True))


def test_the_seed_of_a_reset_determines_the_delays():
    delay = FrameDelay(4, 3, 0.2)
    assert play(delay, seed=1) == play(delay, seed=1) != play(delay, seed=2)


@pytest.mark.parametrize("obs_type", ["pixels", "pixels_agent_pos"])
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_gymnasium_accepts_the_wrapped_tasks(obs_type):
    env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type=obs_type, disable_env_checker=True)
    env = DelayFrames(env, FrameDelay(3, 2, 0.2))
    check_env(env, skip_render_check=True)
    assert gym.make(env.spec, disable_env_checker=True).delay == env.delay


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
@pytest.mark.filterwarnings("ignore:.*A Box observation space")
def test_a_frame_may_be_a_dict():
    env = gym.make("dynmap_rl/Task-v0", task="balance_reaching", disable_env_checker=True)
    env = DelayFrames(env, FrameDelay(3, 2, 0.2))
    assert isinstance(env.observation_space["pixels"], gym.spaces.Dict)
    check_env(env, skip_render_check=True)


def test_only_the_frame_is_late():
    arguments = {"obs_type": "pixels_agent_pos", "disable_env_checker": True}
    plain = gym.make("dynmap_rl/BalanceReaching-v1", **arguments)
    late = DelayFrames(gym.make("dynmap_rl/BalanceReaching-v1", **arguments), FrameDelay(2))
    rows = [[env.reset(seed=3)[0]] for env in (plain, late)]
    plain.action_space.seed(0)
    for _ in range(6):
        action = plain.action_space.sample()
        for env, row in zip((plain, late), rows, strict=True):
            row.append(env.step(action)[0])
    for t, (now, then) in enumerate(zip(*rows, strict=True)):
        np.testing.assert_array_equal(now["agent_pos"], then["agent_pos"])
        np.testing.assert_array_equal(rows[0][max(t - 2, 0)]["pixels"], then["pixels"])


def test_a_robot_s_actor_in_the_wrapper_without_delay_is_the_actor():
    model = make_model()
    actor = Actor(model, make_policy(CONSTANTS, "recurrent", model, width=20)).eval()
    robot, env = (
        RobotActor(DelayedActor(actor, max_delay=3)),
        DelayFrames(
            gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels_agent_pos", disable_env_checker=True),
            FrameDelay(),
        ),
    )
    observation, info = env.reset(seed=0)
    robot.reset(observation["agent_pos"][3:])
    td = None
    for t in range(8):
        for age, frame in info["arrived"]:
            robot.observe(frame, 0.05 * (t - age))
        action = robot.act(0.05 * t)
        with torch.no_grad():
            pixels = torch.from_numpy(observation["pixels"]).movedim(-1, 0)
            entries = {"pixels": pixels, "goal": robot.goal}
            td = actor((td["next"] if td is not None else robot.memory.empty()).update(entries))
        np.testing.assert_array_equal(action, td["action"].numpy())
        observation, _, _, _, info = env.step(action)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": -1}, "steps must be at least 0, got -1"),
        ({"steps": 1, "jitter": 2}, "jitter must be at most the delay of 1 steps, got 2"),
        ({"lost": 1.5}, "lost must be a probability, 0 to 1, got 1.5"),
        ({"lost": -0.5}, "lost must be a probability, 0 to 1, got -0.5"),
        ({"lost": float("nan")}, "lost must be a probability"),
        ({"steps": 1.5}, "steps must be a whole number"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        FrameDelay(**settings)


@pytest.mark.parametrize("seed", [0, 7, 2**40])
def test_delays_and_scenes_of_a_seed_are_independent(seed):
    streams = [np.random.default_rng(seed), *(np.random.default_rng([seed, tag]) for tag in range(1, 4))]
    streams += [make_generator(seed), make_generator(seed, 1)]
    assert len({tuple(stream.random(4)) for stream in streams}) == len(streams)
