"""What holds for every task; and task 1."""

import math

import numpy as np
import pytest
import torch

from dynmap_rl.envs.gym_env import DynmapEnv
from dynmap_rl.envs.scene import BinRanges, ObstacleRanges, Scene, SceneRanges, choose_ranges
from dynmap_rl.envs.task import MARKER_SIZE
from dynmap_rl.envs.tasks import FAILURE, TASKS, get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACTION_LIMIT, EPISODE_STEPS, World
from dynmap_rl.experts.network import load_expert

TASK = get_task("balance_reaching")
STILL = np.zeros(3)
PROGRESS = 5 * math.hypot(*ACTION_LIMIT[:2])  # the most that a step of task 2 adds
REWARDS = {  # what each says of its range
    "balance_reaching": (FAILURE, 1.0),
    "balance_reaching_obstacle": (FAILURE, 1.0 + PROGRESS),
    "bin_dropping": (FAILURE / 4, 1.0),
}

every_task = pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)


def world_at(distance: float, **factors) -> World:
    """Goal and cart on one height, so far apart."""
    return World(Scene(cart_x=0.3, cart_y=0.4, goal_x=0.3 + distance, goal_y=0.4, **factors))


def after_episode(world: World) -> World:
    for _ in range(EPISODE_STEPS):
        world.step(STILL)
    return world


# Every task


@pytest.mark.parametrize("known", TASKS)
def test_unknown_task_names_the_known_ones(known):
    with pytest.raises(ValueError, match=f"'{known}'"):
        get_task("nope")


@every_task
def test_reward_stays_in_its_range(task):
    """For wild actions, and for those of the expert, which come near the upper end."""
    rng, expert = np.random.default_rng(0), load_expert(task.name)
    rewards = []
    for seed in range(4):
        world = task.make_world(task.sample_scene(np.random.default_rng(seed)))
        for _ in range(EPISODE_STEPS):
            mean, _ = expert(torch.from_numpy(task.state(world)))
            world.accelerate(mean.numpy() if seed % 2 else 100 * rng.normal(size=3))
            rewards.append(task.reward(world))
    low, high = REWARDS[task.name]
    assert low <= min(rewards) and 0.95 < max(rewards) <= high


@every_task
def test_state_is_finite_and_bounded_even_after_a_drop(task):
    rng = np.random.default_rng(0)
    world = task.make_world(task.ranges.scene(block_height=0.2))
    for _ in range(EPISODE_STEPS):
        world.step(rng.normal(size=3))
        state = task.state(world)
        assert state.shape == (task.state_size,) and state.dtype == np.float32
        assert (np.abs(state) <= 10).all()
    assert world.dropped


@every_task
def test_state_knows_no_colours(task):
    scene = task.ranges.scene()
    colored = scene.replace(cart_color=(200, 0, 0), block_color=(0, 9, 9), background_color=(0, 0, 0))
    plain, red = task.make_world(scene), task.make_world(colored)
    np.testing.assert_array_equal(task.state(plain), task.state(red))


@every_task
def test_state_begins_as_that_of_task_1_behind_the_goal(task):
    world = task.make_world(task.ranges.scene())
    for _ in range(10):
        world.accelerate([1.0, 0.5, 0.5])
    np.testing.assert_array_equal(task.state(world)[2:16], TASK.state(world)[2:16])


@every_task
def test_policies_are_given_the_scenes_goal(task):
    scene = task.sample_scene(np.random.default_rng(0))
    np.testing.assert_array_equal(task.goal(task.make_world(scene)), [scene.goal_x, scene.goal_y])


@every_task
def test_no_start_is_solved_or_lost(task):
    for seed in range(30):
        world = task.make_world(task.sample_scene(np.random.default_rng(seed)))
        for _ in range(2):
            assert not task.is_success(world) and not task.is_over(world)
            world.step(STILL)
        assert world.touched == set() and not world.dropped


@pytest.mark.parametrize("make", [DynmapEnv, DynmapBatchedEnv])
@pytest.mark.parametrize(
    ("task", "ranges", "needed"),
    [
        ("bin_dropping", SceneRanges(), "BinRanges"),
        ("bin_dropping", ObstacleRanges(), "BinRanges"),
        ("balance_reaching_obstacle", SceneRanges(), "ObstacleRanges"),
        ("balance_reaching_obstacle", BinRanges(), "ObstacleRanges"),
    ],
)
def test_ranges_of_another_task_raise(make, task, ranges, needed):
    with pytest.raises(ValueError, match=f"{needed}.*got {type(ranges).__name__}"):
        make(task, ranges=ranges)


@every_task
def test_own_ranges_are_the_default(task):
    assert choose_ranges(task.ranges, None) is task.ranges
    assert isinstance(task.sample_scene(np.random.default_rng(0)), task.ranges.scene)


# Task 1


def test_task_1_takes_scenes_with_more_in_them():
    assert isinstance(TASK.sample_scene(np.random.default_rng(0), BinRanges()), Scene)
    DynmapEnv(ranges=ObstacleRanges()).reset(seed=0)


def test_reward_grows_towards_the_goal():
    rewards = [TASK.reward(world_at(d)) for d in (0.0, 0.02, 0.1, 0.3, 0.5)]
    assert rewards[0] == pytest.approx(1.0)
    assert rewards == sorted(rewards, reverse=True)
    assert rewards[-1] > 0


def test_reward_is_less_for_effort_and_tilt():
    moving, tilted = world_at(0.3), world_at(0.3)
    moving.accelerate([2.0, 0.0, 0.0])
    tilted.position[2] = 0.3
    assert TASK.reward(moving) < TASK.reward(world_at(0.3))
    assert TASK.reward(tilted) < TASK.reward(world_at(0.3))


def test_dropped_block_is_a_failure():
    world = world_at(0.0)
    world.dropped = True
    assert TASK.reward(world) == FAILURE


@pytest.mark.parametrize("distance, success", [(0.0, True), (0.049, True), (0.051, False)])
def test_success_is_a_final_error_under_50_mm(distance, success):
    assert TASK.is_success(after_episode(world_at(distance))) is success


def test_no_success_before_the_last_step_or_after_a_drop():
    world = world_at(0.0)
    for _ in range(EPISODE_STEPS - 1):
        world.step(STILL)
        assert not TASK.is_success(world)
    world.step(STILL)
    assert TASK.is_success(world)
    world.dropped = True
    assert not TASK.is_success(world)


def test_state_of_a_resting_world():
    state = TASK.state(world_at(0.25, cart_width=0.25, block_height=0.16, block_shift=0.02))
    expected = np.zeros(16)
    expected[[0, 2, 3, 8]] = 0.5, -0.4, -0.2, 0.2  # goal, cart, block's shift
    np.testing.assert_allclose(state, expected, atol=1e-6)


def test_marker_is_a_square_at_the_goal():
    scene = Scene(goal_x=0.6, goal_y=0.3)
    [(polygon, _)] = TASK.markers(scene)
    np.testing.assert_allclose(np.mean(polygon, 0), TASK.goal(World(scene)))
    np.testing.assert_allclose(np.ptp(polygon, 0), MARKER_SIZE)
