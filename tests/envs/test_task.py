"""Tasks of users, in modules of their own, named as ``module:Class``: the one of the README, from end to end."""

import json
import re
import sys
from pathlib import Path

import commands
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import dynmap_rl.envs
from dynmap_rl.envs.gym_env import DynmapEnv
from dynmap_rl.envs.renderer import Renderer
from dynmap_rl.envs.scene import Scene
from dynmap_rl.envs.task import Task, base_state
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import EPISODE_STEPS

README = (Path(dynmap_rl.envs.__file__).parent / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.S)
[MODULE] = [code for code in SNIPPETS if "class Lift" in code]
OWN_GOAL = """

class Above(Lift):
    def goal(self, world):
        return world.scene.cart_x, world.scene.goal_y

    def is_success(self, world):
        return True


class Unfinished(Task):
    name = "unfinished"

    def reward(self, world):
        return 0.0


class Smallest(Unfinished):
    description = "Wait."

    def is_success(self, world):
        return True
"""
NAME, ABOVE = "my_tasks:Lift", "my_tasks:Above"
START = {"cart_x": 0.5, "cart_y": 0.2, "cart_height": 0.04, "block_height": 0.16}
START |= {"goal_y": 0.5, "ceiling": 0.84}
BLOCK_START = 0.3


@pytest.fixture(autouse=True)
def my_tasks(tmp_path, monkeypatch):
    """The module, where Python finds it for the time of a test."""
    (tmp_path / "my_tasks.py").write_text(MODULE + OWN_GOAL)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    sys.modules.pop("my_tasks", None)


def lift(env: DynmapEnv, height: float) -> list[tuple]:
    """The steps of an episode in which the cart goes up smoothly by a height."""
    env.reset(seed=0, options=START)
    path = height * (1 - np.cos(np.linspace(0, np.pi, EPISODE_STEPS - 19))) / 2
    path = np.concatenate([path, np.full(20, height)])
    return [env.step(np.array([0.0, dy, 0.0]))[1:] for dy in np.diff(path)]


def test_the_readmes_snippets_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for snippet in SNIPPETS:
        exec(compile(snippet, "README", "exec"), namespace)
    assert namespace["imagined"].shape == (4, 30)


def test_a_task_must_define_its_name_description_reward_and_success():
    assert Task.__abstractmethods__ == {"name", "description", "reward", "is_success"}
    with pytest.raises(ValueError, match="my_tasks:Unfinished.*description, is_success"):
        get_task("my_tasks:Unfinished")
    with pytest.raises(ValueError, match="dynmap_rl.envs.Task"):
        get_task("my_tasks:LiftScene")


def test_defaults_are_a_scene_without_walls_with_a_square_at_the_goal():
    task = get_task("my_tasks:Smallest")
    scene = task.sample_scene(np.random.default_rng(0))
    world = task.make_world(scene)
    assert type(scene) is Scene and len(world.space.static_body.shapes) == 1  # the ground
    np.testing.assert_array_equal(task.state(world), base_state(world))
    np.testing.assert_array_equal(task.goal(world), [scene.goal_x, scene.goal_y])
    [(polygon, _)] = task.markers(scene)
    np.testing.assert_allclose(np.mean(polygon, 0), [scene.goal_x, scene.goal_y])
    assert not task.is_over(world)
    world.dropped = True
    assert task.is_over(world)
    assert DynmapBatchedEnv("my_tasks:Smallest", 2, from_pixels=True).rollout(3)["state"].shape == (2, 3, 16)


def test_own_task_needs_no_place_among_the_shipped_ones():
    assert get_task(NAME).name == "lift"
    assert "lift" not in TASKS and NAME not in TASKS


@pytest.mark.parametrize("error, success", [(0.0, True), (0.025, True), (-0.025, True), (0.035, False)])
def test_own_success_is_told_by_gymnasium(error, success):
    env = DynmapEnv(NAME)
    steps = lift(env, 0.5 - BLOCK_START + error)
    assert len(steps) == EPISODE_STEPS
    told = [bool(info["is_success"]) for *_, info in steps]
    assert told == [False] * (EPISODE_STEPS - 1) + [success]
    assert not any(terminated for _, terminated, *_ in steps)
    assert steps[-1][0] == pytest.approx(np.exp(-8 * abs(error)), abs=0.01)


def test_own_reward_grows_with_the_lift():
    rewards = [reward for reward, *_ in lift(DynmapEnv(NAME), 0.2)]
    assert rewards[0] < 0.3 < rewards[50] < 0.95 < rewards[-1]


def test_own_factor_is_drawn_can_be_fixed_and_is_seen_by_experts():
    env, task = DynmapEnv(NAME), get_task(NAME)
    ceilings = {task.sample_scene(np.random.default_rng(seed)).ceiling for seed in range(20)}
    assert len(ceilings) == 20 and all(0.84 <= ceiling <= 0.94 for ceiling in ceilings)
    state, _ = env.reset(seed=0, options={"ceiling": 0.84})
    assert state in env.observation_space and state.shape == (17,)
    assert state[-1] == pytest.approx(-1)


@pytest.mark.parametrize("height, touched", [(0.44, False), (0.46, True)])
def test_own_wall_is_in_the_way(height, touched):
    """The top of the block starts 450 mm below it."""
    assert any(info["touched"] for *_, info in lift(DynmapEnv(NAME), height)) is touched


def test_own_goal_is_what_policies_are_given():
    env, batched = DynmapEnv(ABOVE, obs_type="pixels_agent_pos"), DynmapBatchedEnv(ABOVE)
    observation, _ = env.reset(seed=3)
    td = batched.reset(batched.fake_tensordict().empty().set("scene_seed", torch.tensor([3])))
    goal = np.float32([env.world.scene.cart_x, env.world.scene.goal_y])
    for given in (observation["agent_pos"][3:], td["agent_pos"][0, 3:], td["goal"][0]):
        np.testing.assert_array_equal(given, goal)


@pytest.mark.parametrize("arguments", [{}, {"num_envs": 2, "from_pixels": True, "control": "acceleration"}])
def test_own_task_is_a_torchrl_environment(arguments):
    check_env_specs(DynmapBatchedEnv(NAME, **arguments), seed=0)


def test_both_adapters_take_it_alike():
    env, batched = DynmapEnv(NAME, obs_type="pixels"), DynmapBatchedEnv(NAME, from_pixels=True)
    td = batched.reset(batched.fake_tensordict().empty().set("scene_seed", torch.tensor([7])))
    pixels, _ = env.reset(seed=7)
    np.testing.assert_array_equal(td["pixels"][0].permute(1, 2, 0), pixels)
    for _ in range(10):
        action = np.array([0.002, 0.01, 0.001], dtype=np.float32)
        pixels, reward, *_ = env.step(action)
        td = batched.step(td.set("action", torch.from_numpy(action)[None]))["next"]
        np.testing.assert_array_equal(td["pixels"][0].permute(1, 2, 0), pixels)
        assert td["reward"].item() == np.float32(reward)


def test_own_markers_are_drawn_as_lines_across_the_picture():
    task = get_task(NAME)
    world = task.make_world(task.ranges.scene(cart_y=0.2, goal_y=0.6, ceiling=0.9))
    rows, columns = (Renderer().draw(world, task) == (0, 200, 0)).all(-1).nonzero()
    heights = 1 - (rows + 0.5) / 64
    assert (np.minimum(abs(heights - 0.6), abs(heights - 0.9)) < 0.03).all()
    for line in (0.6, 0.9):
        near = abs(heights - line) < 0.03
        assert set(columns[near]) == set(range(64))
        assert heights[near].mean() == pytest.approx(line, abs=1 / 64)


@pytest.mark.parametrize("name", ["my_tasks:Nope", "my_taskz:Lift", "my_tasks:", ":Lift", "Lift"])
@pytest.mark.parametrize("make", [get_task, DynmapEnv, DynmapBatchedEnv])
def test_a_task_that_is_not_there_is_one_clear_error(make, name):
    with pytest.raises(ValueError, match=f"task .*'{name}'"):
        make(name)


@pytest.mark.slow
def test_the_recipes_take_it_from_the_expert_to_the_row(tmp_path):
    """In the folder that holds the module; of an expert this short, all counts as success."""
    from dynmap_rl.data.demonstrations import load_meta

    task = ["--task", ABOVE]
    expert = [*task, "--expert", "runs/expert/lift/checkpoint"]
    episodes = ["--episodes", "4", "--eval_episodes", "2", "--workers", "1"]
    commands.run_small(tmp_path, "expert", *task)
    result = commands.run(tmp_path, "collect", *expert, *episodes)
    assert result.returncode == 0, result.stderr
    dataset = tmp_path / "datasets/lift"
    scenes = [row["scene"] for row in load_meta(dataset)["episodes"]]
    assert len({scene["ceiling"] for scene in scenes}) == 6
    commands.run_small(tmp_path, "decoupled", *task, "--dataset", "datasets/lift")
    [row] = (tmp_path / "runs/decoupled/lift").glob("*/eval.json")
    assert json.loads(row.read_text())["task"] == ABOVE
