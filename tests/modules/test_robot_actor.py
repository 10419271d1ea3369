"""Actor on a robot's clock against the delayed actor, whose delays count steps."""

import warnings

import numpy as np
import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.modules.robot_actor import RobotActor

GOAL = np.array([0.3, 0.6])
FRAMES = np.random.default_rng(0).integers(0, 256, (12, 64, 64, 3), np.uint8)
DT = 0.05


def make_actor(max_delay=4):
    model = make_model()
    return DelayedActor(
        Actor(model, make_policy(CONSTANTS, "recurrent", model, width=20)), max_delay=max_delay
    )


def make_robot(**arguments):
    robot = RobotActor(make_actor(), **arguments)
    robot.reset(GOAL)
    return robot


@torch.no_grad()
def run_in_steps(schedule):
    """Return the actions where ``schedule[t]`` are the steps of the frames that arrive at t."""
    actor, memory, actions = make_actor().eval(), TensorDict(), []
    for t, taken in enumerate(schedule):
        td = memory.set("goal", torch.as_tensor(GOAL, dtype=torch.float32))
        if taken:
            td["pixels"] = torch.from_numpy(FRAMES[taken]).movedim(-1, -3)
            td["delay"] = torch.tensor([t - s for s in taken])
        actions.append(actor(td)["action"].numpy())
        memory = td["next"]
    return np.stack(actions)


SCHEDULE = [[0], [], [], [2, 1], [], [5], [3], [], [6, 8]]


@pytest.mark.parametrize("unit", [1, 1000])
def test_timestamps_become_steps(unit):
    """Frames and calls are up to 10 ms off the beat, and the clock does not begin at 0."""
    robot, noise, actions = make_robot(period=DT * unit), np.random.default_rng(1), []
    start, shift = 1234.5 * unit, 0.01 * unit
    for t, taken in enumerate(SCHEDULE):
        for s in taken:
            robot.observe(FRAMES[s], start + s * DT * unit + noise.uniform(-shift, shift))
        actions.append(robot.act(start + t * DT * unit + noise.uniform(-shift, shift)))
    assert actions[0].shape == (3,) and actions[0].dtype == np.float32
    np.testing.assert_array_equal(actions, run_in_steps(SCHEDULE))


def test_the_episode_begins_with_the_first_action():
    """The robot is at rest before: its newest frame is as good as a new one, and older ones hold nothing new."""
    robot = make_robot()
    robot.observe(FRAMES[0], 9.7)
    robot.observe(FRAMES[7], 9.5)
    actions = [robot.act(10.0)]
    robot.observe(FRAMES[8], 9.9)
    robot.observe(FRAMES[1], 10.05)
    actions.append(robot.act(10.05))
    np.testing.assert_array_equal(actions, run_in_steps([[0], [1]]))


def test_frames_that_are_too_old_are_not_used():
    robot = make_robot()
    robot.observe(FRAMES[0], 0.0)
    actions = [robot.act(t * DT) for t in range(6)]
    robot.observe(FRAMES[1], 1 * DT)  # 5 steps before the next action
    actions.append(robot.act(6 * DT))
    np.testing.assert_array_equal(actions, run_in_steps([[0], *[[]] * 6]))


@torch.no_grad()
@pytest.mark.parametrize("hold", [False, True])
def test_missed_steps_have_no_action_or_the_last_one(hold):
    robot = make_robot(hold=hold)
    robot.observe(FRAMES[0], 0.0)
    before = torch.from_numpy(robot.act(0.0))
    robot.observe(FRAMES[2], 0.1)
    action = robot.act(0.15)

    actor, goal = make_actor().eval(), torch.as_tensor(GOAL, dtype=torch.float32)
    first = actor(TensorDict({"goal": goal, "pixels": torch.from_numpy(FRAMES[0]).movedim(-1, 0)}))["next"]
    memory = first.clone()
    for _ in range(2):
        td = actor.predict(actor.observe(memory.clone()).set("action", before if hold else torch.zeros(3)))
        memory = td["next"].update(first.select(*actor.actor.latent_actor.policy_memory))
    pixels = torch.from_numpy(FRAMES[2]).movedim(-1, 0)
    td = actor(memory.update({"goal": goal, "pixels": pixels, "delay": torch.tensor([1])}))
    np.testing.assert_array_equal(action, td["action"].numpy())


def test_a_long_gap_takes_no_more_steps_than_the_longest_delay(monkeypatch):
    robot, calls = make_robot(), []
    robot.observe(FRAMES[0], 0.0)
    robot.act(0.0)
    predict = robot.actor.predict
    monkeypatch.setattr(robot.actor, "predict", lambda td: calls.append(1) or predict(td))
    assert np.isfinite(robot.act(10.0)).all()
    assert len(calls) == robot.actor.max_delay + 1


def test_reset_forgets_the_episode_and_takes_a_goal():
    robot = make_robot()
    actions = []
    for goal in (GOAL, GOAL, GOAL + 0.2):
        robot.reset(goal)
        robot.observe(FRAMES[0], 1.0)
        actions.append([robot.act(1.0), robot.act(1.05)])
    np.testing.assert_array_equal(actions[0], actions[1])
    assert not np.allclose(actions[0], actions[2])
    robot.reset(GOAL)
    with pytest.raises(ValueError, match="call observe before act"):
        robot.act(2.0)


@pytest.mark.parametrize("late", [0.02, 0.03, 0.035])
def test_a_late_call_and_a_punctual_one_after_it_are_two_steps(late):
    robot, regular = make_robot(), make_robot()
    for t in range(9):
        now = t * DT + late * (t % 2)
        robot.observe(FRAMES[t], now)
        regular.observe(FRAMES[t], t * DT)
        np.testing.assert_array_equal(robot.act(now), regular.act(t * DT))
    assert robot.step == 8


@pytest.mark.parametrize("period", [0.02, 0.049, 0.06, 0.076, 0.12])
def test_calls_at_another_rate_count_the_time(period):
    robot = make_robot()
    robot.observe(FRAMES[0], 0.0)
    times = np.arange(30) * period
    for now in times:
        robot.act(now)
    assert robot.step == pytest.approx(max(29, times[-1] / DT), abs=1)


def test_the_beat_is_that_of_the_earliest_calls():
    robot = make_robot()
    robot.observe(FRAMES[0], 0.03)
    for now in (0.03, 0.05, 0.1, 0.15, 0.255):
        robot.act(now)
    assert robot.step == 5  # the call at 0.2 was missed


def test_frames_of_the_last_episode_are_not_used():
    robot = make_robot()
    robot.observe(FRAMES[3], 1.0)
    first = robot.act(1.0)
    robot.reset(GOAL, since=2.0)
    robot.observe(FRAMES[5], 1.9)
    with pytest.raises(ValueError, match="observe"):
        robot.act(2.0)
    robot.observe(FRAMES[3], 2.0)
    np.testing.assert_array_equal(robot.act(2.05), first)


def test_frames_of_another_clock_get_a_warning():
    robot = make_robot()
    for t in range(6):
        robot.observe(FRAMES[t], 100 + t * DT)
        if t < 4:
            robot.act(1000 + t * DT)
        else:  # the fourth frame that is too old
            with pytest.warns(UserWarning, match="one clock") if t == 4 else warnings.catch_warnings():
                warnings.simplefilter("error" if t > 4 else "default")
                robot.act(1000 + t * DT)


@pytest.mark.parametrize("order", [1, -1])
def test_the_frame_nearest_to_a_call_is_its_frame(order):
    robot = make_robot()
    robot.observe(FRAMES[0], 0.0)
    robot.act(0.0)
    robot.act(0.05)
    for frame, time in [(FRAMES[1], 0.051), (FRAMES[9], 0.066)][::order]:
        robot.observe(frame, time)
    np.testing.assert_array_equal(robot.act(0.1), run_in_steps([[0], [], [1]])[-1])


def test_a_camera_may_use_its_buffer_again():
    robot, buffer = make_robot(), FRAMES[0].copy()
    robot.observe(buffer, 0.0)
    buffer[:] = 0
    np.testing.assert_array_equal(robot.act(0.0), run_in_steps([[0]])[0])


def test_a_goal_may_be_changed_by_its_owner():
    goal = GOAL.astype(np.float32)
    robot = RobotActor(make_actor())
    robot.reset(goal)
    goal[:] = 9
    np.testing.assert_allclose(robot.goal.numpy(), GOAL, rtol=1e-6)


def test_wrong_use_gets_one_clear_error():
    robot = RobotActor(make_actor())
    with pytest.raises(ValueError, match="reset"):
        robot.observe(FRAMES[0], 0.0)
    with pytest.raises(ValueError, match="reset"):
        robot.act(0.0)
    robot.reset(GOAL)
    for frame in (FRAMES[0] / 255, FRAMES[0][:48, :48]):
        with pytest.raises(ValueError, match=r"uint8 \[64, 64, 3\]"):
            robot.observe(frame, 0.0)
    with pytest.raises(ValueError, match="timestamp"):
        robot.observe(FRAMES[0], float("nan"))
    robot.observe(FRAMES[0], 0.0)
    robot.act(5.0)
    robot.observe(FRAMES[0], 6.0)
    with pytest.raises(ValueError, match="one clock"):
        robot.act(5.05)
    for goal in ([0.5], 0.5, [0.5, float("nan")], np.empty(0)):
        with pytest.raises(ValueError, match="goal must be 2 finite numbers"):
            RobotActor(make_actor()).reset(goal)
    for now, message in (
        (5.0, "monotonic"),
        (0.0, "monotonic"),
        (float("nan"), "finite"),
        (float("inf"), "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            robot.act(now)
    with pytest.raises(ValueError, match="max_delay"):
        RobotActor(make_actor(max_delay=0))
    with pytest.raises(ValueError, match="period"):
        RobotActor(make_actor(), period=0)


def test_a_wrong_period_gets_a_warning():
    robot = make_robot()
    robot.observe(FRAMES[0], 0.0)
    for call in range(14):
        with pytest.warns(UserWarning, match="1 / fps") if call == 10 else warnings.catch_warnings():
            warnings.simplefilter("default" if call == 10 else "error")
            robot.act(call * 0.1)  # every second step of 0.05 s


@pytest.mark.parametrize("ahead", [0.9, 1.1])
def test_a_frame_may_be_taken_up_to_a_period_after_the_call(ahead):
    robot = make_robot()
    robot.observe(FRAMES[0], 0.0)
    robot.act(0.0)
    robot.observe(FRAMES[1], DT + ahead * DT)
    if ahead < 1:
        assert np.isfinite(robot.act(DT)).all()
    else:
        with pytest.raises(ValueError, match="one clock"):
            robot.act(DT)


def test_it_does_not_train():
    assert not RobotActor(make_actor().train()).actor.training


def test_it_needs_an_actor_with_delays():
    model = make_model()
    actor = Actor(model, make_policy(CONSTANTS, "feedforward", model, width=20))
    with pytest.raises(TypeError, match="must be a DelayedActor, got Actor"):
        RobotActor(actor)


def test_frames_do_not_pile_up_while_a_robot_is_paused():
    robot = RobotActor(make_actor(max_delay=3), period=0.1)
    robot.reset(GOAL)
    for i in range(100):
        robot.observe(FRAMES[0], i * 0.1)
    assert len(robot.frames) <= 6 and robot.frames[-1][0] == pytest.approx(9.9)


def test_actions_stay_in_the_range_of_the_demonstrations_and_a_far_goal_gets_a_warning():
    robot = make_robot()
    with pytest.warns(UserWarning, match="far outside"):
        robot.reset(1000 * GOAL)
    robot.observe(FRAMES[0], 0.0)
    low, high = (np.array(CONSTANTS["action"][name], np.float32) for name in ("low", "high"))
    for t in range(4):
        action = robot.act(DT * t)
        assert (low - 1e-6 <= action).all() and (action <= high + 1e-6).all()
