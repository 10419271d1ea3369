"""A Gymnasium environment with MuJoCo as a task: one of one's own, and those of the benchmarks."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from own_task import check_renderer, own_task, read_code  # noqa: F401
from torchrl.envs.utils import check_env_specs

from dynmap_rl.data.recording import demonstrators
from dynmap_rl.data.recording.demonstrators import demonstrate
from dynmap_rl.data.recording.plans import plan_demonstrations, run_plans
from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv

KEYS = "pixels", "agent_pos", "goal", "state", "dynamics", ("next", "reward")
BENCHMARKS = "FetchPush", "FetchSlide", "PlateSlide", "Soccer"


def roll(task, seeds, steps=12, **arguments):
    env = DynmapBatchedEnv(task, len(seeds), from_pixels=True, **arguments)
    td, out = env.reset(scene_seed=torch.tensor(seeds)), []
    for t in range(steps):
        action = 0.8 * torch.ones_like(env.action_spec.zero()) * (t > 2)
        td = env.step(td.set("action", action))
        out.append(td.select(*KEYS))
        td = td["next"]
    return env, torch.stack(out, 1)


def test_a_task_takes_fewer_than_60_lines():
    assert len(read_code().splitlines()) < 60


def test_the_environment_has_the_sizes_of_the_layout(own_task):  # noqa: F811
    env = DynmapBatchedEnv(own_task, 2, from_pixels=True, seed=0)
    check_env_specs(env)
    layout = env.layout
    assert layout == Layout.from_dict(layout.to_dict())
    assert layout.position[:3] == ("puck_x", "puck_y", "puck_z") and len(layout.position) == 9
    assert env.observation_spec["dynamics", "velocity"].shape == (2, len(layout.velocity))
    assert env.observation_spec["goal"].shape == (2, 3)
    with pytest.raises(ValueError, match="finite"):
        env.step(env.reset().set("action", torch.full((2, 1), torch.nan)))


def test_an_episode_depends_on_its_seed_alone(own_task):  # noqa: F811
    _, pair = roll(own_task, [3, 4])
    env, single = roll(own_task, [4])
    assert (pair[1:] == single).all()
    assert not torch.equal(pair[0, 0]["goal"], pair[1, 0]["goal"])
    again = env.reset(scene_seed=torch.tensor([4]))  # in a used simulator
    assert (again.select(*KEYS[:-1]) == single[:, 0].select(*KEYS[:-1])).all()


def test_dynamics_agree_with_each_other(own_task):  # noqa: F811
    env, out = roll(own_task, [0], steps=20)
    position, velocity, acceleration = (
        out["dynamics", q][0].double() for q in ("position", "velocity", "acceleration")
    )
    moved = position[1:, :3] - position[:-1, :3]
    assert moved[:, 0].max() > 0.01
    mean = (velocity[1:, :3] + velocity[:-1, :3]) / 2 * env.layout.dt
    assert (moved - mean).abs().mean() < 0.15 * moved.abs().max()
    assert (acceleration[0] == 0).all()
    torch.testing.assert_close(
        acceleration[1:], (velocity[1:] - velocity[:-1]) / env.layout.dt, rtol=1e-3, atol=1e-3
    )


def test_the_demonstrator_succeeds(own_task):  # noqa: F811
    task = get_task(own_task)
    world = task.begin(0)
    act = task.demonstrator(world)
    for _ in range(task.layout.steps):
        assert not task.is_over(world)
        task.step([world], [act()])
    assert task.is_success(world) and task.distance(world) == world.position_error < 0.06


def check_recordings(task):
    plans = plan_demonstrations(task, "train", 0, 4)
    first = run_plans(task, plans[2:])
    run_plans(task, plans[:2])
    assert (run_plans(task, plans[2:]) == first).all()  # in a used simulator


def test_a_recording_does_not_depend_on_those_before(own_task):  # noqa: F811
    check_recordings(own_task)


def test_a_recording_copies_what_a_task_may_write_over(own_task, monkeypatch):  # noqa: F811
    expected, kind = demonstrate(own_task, [3]), type(get_task(own_task))
    draw, look = kind._draw, kind.agent_pos
    picture, state = np.zeros((64, 64, 3), np.uint8), np.zeros(6, np.float32)

    def write(array: np.ndarray, values: np.ndarray) -> np.ndarray:
        array[:] = values
        return array

    monkeypatch.setattr(kind, "_draw", lambda self, world: write(picture, draw(self, world)))
    monkeypatch.setattr(kind, "agent_pos", lambda self, world: write(state, look(self, world)))
    demonstrators._open_simulator.cache_clear()
    assert (demonstrate(own_task, [3]) == expected).all()
    demonstrators._open_simulator.cache_clear()


def test_arguments_are_a_part_of_the_name(own_task):  # noqa: F811
    task = get_task(f"{own_task}:image_size=96,cameras=2")
    assert task.name == "push_image_size_96_cameras_2" and get_task(own_task).name == "push"
    assert task.layout.cameras == ("front", "top") and task.layout.frame_shape == (3, 96, 192)
    frame = task.make_renderer()(task.begin(0))
    assert frame.shape == (96, 192, 3)
    large = get_task(f"{own_task}:image_size=96")
    assert (large.make_renderer()(large.begin(0)) == frame[:, :96]).all()


def test_a_solved_start_is_followed_by_another_of_the_tasks_own_reset(own_task, monkeypatch):  # noqa: F811
    task, world, starts = get_task(own_task), None, []

    def reset(self, env, seed):
        env.unwrapped.start = np.random.default_rng(seed).random()
        return env.reset(seed=seed)

    monkeypatch.setattr(type(task), "reset", reset)
    monkeypatch.setattr(type(task), "is_solved", lambda self, world: world.env.unwrapped.start < 0.7)
    for seed in (0, 1, 2, 3, 0, 1, 2, 3):
        world = task.begin(seed, None, world)
        starts.append(world.env.unwrapped.start)
    assert min(starts) > 0.7 and len(set(starts)) == 4 and starts[:4] == starts[4:]


def test_a_reset_may_replace_the_model(own_task, monkeypatch):  # noqa: F811
    task = get_task(own_task)
    draw, world = task.make_renderer(), task.begin(3)
    expected = draw(world), world.position.copy()
    reset = type(task).reset

    def replace(self, env, seed):
        env.__init__()
        return reset(self, env, seed)

    monkeypatch.setattr(type(task), "reset", replace)
    world = task.begin(3, None, world)
    assert world.data is world.env.data and (draw(world) == expected[0]).all()
    task.step([world], [np.ones(1)])
    assert not np.array_equal(world.position, expected[1]) and (draw(world) != expected[0]).any()


def test_what_is_dropped_stays_dropped(own_task, monkeypatch):  # noqa: F811
    task, lost = get_task(own_task), [False, True, False]
    monkeypatch.setattr(type(task), "is_dropped", lambda self, world: lost.pop(0))
    world, seen = task.begin(0), []
    while lost:
        task.step([world], [np.zeros(len(task.layout.action))])
        seen.append(world.dropped)
    assert seen == [False, True, True]


@pytest.mark.slow
@pytest.mark.parametrize("name", BENCHMARKS)
def test_the_benchmarks_repeat_bit_by_bit(name):
    check_renderer()
    pytest.importorskip("gymnasium_robotics" if "Fetch" in name else "metaworld")
    _, both = roll(f"mujoco:{name}", [11, 12])
    _, last = roll(f"mujoco:{name}", [12])
    assert (both[1:] == last).all()
    check_recordings(f"mujoco:{name}")


def test_the_goal_stands_last_in_the_state():
    layout = get_task("balance_reaching").layout
    for state in (("cart_x",), ("goal_x", "cart_x")):
        with pytest.raises(ValueError, match="must end with the entries of the goal"):
            replace(layout, state=state)
