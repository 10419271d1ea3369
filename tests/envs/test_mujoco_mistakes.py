"""Mistakes in a task of one's own, each named by one error."""

import copy
import functools
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from own_task import own_task  # noqa: F401

from dynmap_rl.data.recording import demonstrators
from dynmap_rl.data.recording.demonstrators import demonstrate
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("image_size=65", "image_size must be one of"),
        ("cameras=3", "cameras must be 1 to 2"),
        ("color=1", "arguments of the task"),
        ("image_size=__import__('os')", "image_size must be one of"),
        ("cameras=front", "cameras must be 1 to 2"),
        ("cameras=1,cameras=2", "different names"),
        ("", "different names"),
    ],
)
def test_wrong_arguments_are_refused(own_task, arguments, message):  # noqa: F811
    with pytest.raises(ValueError, match=message):
        get_task(f"{own_task}:{arguments}")


def test_what_is_for_cart_and_block_is_refused(own_task):  # noqa: F811
    with pytest.raises(ValueError, match="must be a task of cart and block"):
        DynmapBatchedEnv(own_task, 1, control="acceleration")
    with pytest.raises(ValueError, match="without ranges"):
        DynmapBatchedEnv(own_task, 1, ranges=get_task("balance_reaching").ranges)


def test_an_environment_that_does_not_fit_is_refused(own_task, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    monkeypatch.setattr(type(task), "action", ("x", "y"))
    with pytest.raises(ValueError, match="actions of 2 entries"):
        task.begin(0)
    monkeypatch.setattr(type(task), "action", ("x",))
    env = task.make()
    env.action_space = gymnasium.spaces.Box(0, 1, (1,), np.float32)
    monkeypatch.setattr(type(task), "make", lambda self: env)
    with pytest.raises(ValueError, match="actions of 1 entries"):
        task.begin(0)
    monkeypatch.undo()
    monkeypatch.setattr(type(task), "is_solved", lambda self, world: True)
    with pytest.raises(ValueError, match="starts that are not solved"):
        task.begin(0)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("fps", 10, "fps must be 20"),
        ("goal", lambda self, world: np.zeros(2), r"\[3\], got \[2\]"),
        ("make", lambda self: gymnasium.make("CartPole-v1"), "must have MuJoCo's model"),
    ],
)
def test_mistakes_of_a_task_are_named(own_task, monkeypatch, name, value, message):  # noqa: F811
    task = get_task(own_task)
    monkeypatch.setattr(type(task), name, value)
    with pytest.raises(ValueError, match=message):
        task.step([task.begin(0)], [np.ones(1)])


def test_steps_that_say_nothing_of_success_and_unstable_ones_are_refused(own_task, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    with pytest.raises(ValueError, match="1 finite numbers"):
        task.step([world], [np.ones(2)])
    step = type(world.env).step
    monkeypatch.setattr(type(world.env), "step", lambda self, action: (*step(self, action)[:4], {}))
    with pytest.raises(ValueError, match="override is_solved"):
        task.step([world], [np.ones(1)])
    world.data.qpos[:] = np.nan
    monkeypatch.setattr(type(world.env), "step", lambda self, action: (0, 0, False, False, {}))
    with pytest.raises(ValueError, match="unstable in step 2"):
        task.step([world], [np.ones(1)])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("bodies", lambda old: (old[0], old[0]), "different names"),
        ("bodies", lambda old: old[0], "tuple of Body"),
        ("views", lambda old: ("front",), "tuple of Camera"),
        ("views", lambda old: (), "tuple of Camera"),
        ("views", lambda old: (replace(old[0], name="my cam/1"),), "names of views"),
        ("name", lambda old: "Push/3D box", "lower-case"),
        ("steps", lambda old: 0, "whole number of at least 1, got 0"),
        ("fps", lambda old: 12.5, "got 12.5.*frame_skip"),
        ("action_limit", lambda old: (1.0, 1.0), "must be a number.*RescaleAction"),
    ],
)
def test_what_a_task_defines_is_checked(own_task, monkeypatch, name, value, message):  # noqa: F811
    kind = type(get_task(own_task))
    monkeypatch.setattr(kind, name, value(getattr(kind, name)))
    with pytest.raises(ValueError, match=message):
        kind()


def test_a_seed_must_determine_the_start_of_a_recording(own_task, monkeypatch):  # noqa: F811
    kind, counter = type(get_task(own_task)), iter(range(100))
    monkeypatch.setattr(kind, "reset", lambda self, env, seed: env.reset(seed=next(counter)))
    with pytest.raises(ValueError, match="a seed must determine the start"):
        demonstrators._open_simulator.__wrapped__(own_task, kind)


def test_what_a_task_lacks_is_named(own_task, monkeypatch):  # noqa: F811
    kind = type(get_task(own_task))
    monkeypatch.delattr(kind, "fps")
    with pytest.raises(ValueError, match="Push must define fps"):
        kind()


@pytest.mark.parametrize(
    ("argument", "drawn"),
    [("arm=false", False), ("arm=true", True), ("arm=no", "arm"), ("image_size=96.0", "image")],
)
def test_arguments_in_a_name_are_checked(own_task, argument, drawn):  # noqa: F811
    if isinstance(drawn, bool):
        assert get_task(f"{own_task}:{argument}").arm is drawn
    else:
        with pytest.raises(ValueError, match=f"{drawn}.* must be"):
            get_task(f"{own_task}:{argument}")


def test_a_reset_must_set_all_that_the_physics_depend_on(own_task, monkeypatch):  # noqa: F811
    def reset(self, env, seed):
        env.unwrapped.model.body_mass[1:] *= 1.5
        return env.reset(seed=seed)

    kind = type(get_task(own_task))
    monkeypatch.setattr(kind, "reset", reset)
    with pytest.raises(ValueError, match="same seed and actions.*masses"):
        demonstrators._open_simulator.__wrapped__(own_task, kind)


@pytest.mark.parametrize("after", [0, 3])
def test_an_unstable_simulation_is_refused(own_task, after, tmp_path, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    monkeypatch.chdir(tmp_path)  # MuJoCo writes MUJOCO_LOG.TXT
    for _ in range(after):
        task.step([world], [np.zeros(1)])
    world.data.qvel[:] = 1e12
    with pytest.raises(ValueError, match=f"unstable in step {after + 1}"):
        task.step([world], [np.zeros(1)])
    world = task.begin(0, world=world)
    task.step([world], [np.zeros(1)])


def test_an_environment_that_resets_itself_is_refused(own_task):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    task.step([world], [np.zeros(1)])
    real = world.env.step
    world.env.step = lambda action: (world.env.reset(), real(action))[1]
    for _ in range(2):
        world.env.unwrapped.data.time += 1.0
    with pytest.raises(ValueError, match="resets itself in step 2"):
        task.step([world], [np.zeros(1)])


def test_a_used_renderer_is_not_copied(own_task):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    task.make_renderer()(world)
    with pytest.raises(TypeError, match="make another one"):
        copy.deepcopy(world.renderer)


@pytest.mark.parametrize(
    ("expert", "message"),
    [
        (lambda: np.zeros(3), "step 0, scene 0.* must be 1 finite numbers"),
        (lambda: np.array([np.nan]), "1 finite numbers, got .*nan"),
        (functools.partial(next, iter([])), "must act in every step, but ends in step 0"),
        (None, "must return a function"),
    ],
)
def test_a_demonstrator_returns_all_entries(own_task, monkeypatch, expert, message):  # noqa: F811
    monkeypatch.setattr(type(get_task(own_task)), "demonstrator", lambda self, world: expert)
    with pytest.raises(ValueError, match=message):
        demonstrate(own_task, [0])


def test_a_marker_that_is_drawn_elsewhere_is_refused(own_task, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(3)
    np.testing.assert_allclose(world.data.site("goal").xpos, task.goal(world))
    module = sys.modules[type(task).__module__]
    monkeypatch.setattr(module, "XML", module.XML.replace('name="goal" pos="0.2 0 0.03"', 'name="goal"'))
    with pytest.raises(ValueError, match="the site 'goal' has been moved"):
        task.begin(3)


def test_a_refused_action_moves_no_world(own_task):  # noqa: F811
    env = DynmapBatchedEnv(own_task, 3, seed=0)
    td = env.reset()
    for value in (torch.nan, torch.inf):
        action = torch.zeros(3, 1)
        action[2] = value
        with pytest.raises(ValueError, match="finite"):
            env.step(td.set("action", action))
    assert [world.steps for world in env.worlds] == [0, 0, 0]


def test_names_that_would_be_confused_are_refused(own_task, monkeypatch):  # noqa: F811
    task = type(get_task(own_task))
    monkeypatch.setattr(task, "action", ("x", "x"))
    with pytest.raises(ValueError, match="action must have different names"):
        task()
    monkeypatch.undo()
    monkeypatch.setattr(task, "bodies", (*task.bodies[:1], replace(task.bodies[1], name="goal_keeper")))
    with pytest.raises(ValueError, match="goal_keeper"):
        task()


def test_a_reward_that_is_no_number_is_refused(own_task, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    monkeypatch.setattr(world.env, "step", lambda _: (np.zeros(1), np.nan, False, False, {}))
    with pytest.raises(ValueError, match="reward must be finite"):
        task.step([world], [np.zeros(1)])
