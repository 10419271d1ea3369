"""Task 2: around the obstacle, and never against it."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.envs.geometry import length, path_is_blocked, way_around
from dynmap_rl.envs.gym_env import DynmapEnv
from dynmap_rl.envs.scene import ObstacleRanges, ObstacleScene
from dynmap_rl.envs.tasks import FAILURE, get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS, World

TASK = get_task("balance_reaching_obstacle")
BETWEEN = {"obstacle_x": 0.5, "obstacle_y": 0.5, "obstacle_length": 0.2}
ACROSS = ObstacleScene(cart_x=0.2, cart_y=0.5, goal_x=0.8, goal_y=0.5, **BETWEEN)
STILL = np.zeros(3)


def move(world: World, velocity) -> float:
    """One step towards a velocity x, y (m/s); the reward."""
    world.step([*(np.asarray(velocity) * CONTROL_DT), 0.0])
    return TASK.reward(world)


def towards(world: World, point, speed: float = 0.2) -> np.ndarray:
    """The velocity at which the cart, in practice, comes to rest at a point."""
    apart = np.subtract(point, world.position[:2])
    return apart * min(speed / max(np.linalg.norm(apart), 1e-9), 2.0)


@pytest.mark.parametrize(
    ("obstacle_x", "success"), [(0.5, True), (0.18, False)], ids=["clear", "against the cart"]
)
def test_success_needs_the_obstacle_untouched(obstacle_x, success):
    world = TASK.make_world(ACROSS.replace(goal_x=0.2, obstacle_x=obstacle_x, obstacle_y=0.4))
    for _ in range(EPISODE_STEPS):
        world.step(STILL)
        assert TASK.is_success(world) is (success and world.steps == EPISODE_STEPS)
    assert world.position_error < 1e-6 and not world.dropped
    assert TASK.is_over(world) is not success


def test_success_needs_the_goal_and_the_block():
    world = TASK.make_world(ACROSS)
    for _ in range(EPISODE_STEPS):
        world.step(STILL)
    assert not TASK.is_success(world) and not TASK.is_over(world)
    world = TASK.make_world(ACROSS.replace(goal_x=0.2))
    world.block.position = (0.2, 0.8)
    world.block.angle = 1.2
    for _ in range(EPISODE_STEPS):
        world.step(STILL)
    assert world.position_error < 1e-6 and world.touched == set()
    assert TASK.is_over(world) and not TASK.is_success(world)
    assert TASK.reward(world) == FAILURE


def test_touch_terminates_and_is_not_taken_back():
    env = DynmapEnv("balance_reaching_obstacle")
    env.reset(options=ACROSS.to_dict())
    results = []
    for t in range(EPISODE_STEPS):
        forth = env.world.position[0] < 0.4 and t < 60
        results.append(env.step(np.array([0.008 if forth else -0.008, 0, 0]))[1:])
    touched = [bool(info["touched"]) for *_, info in results]
    first = touched.index(True)
    assert 5 < first < 60
    assert touched == [False] * first + [True] * (EPISODE_STEPS - first)
    assert [terminated for _, terminated, *_ in results] == touched
    assert [reward == FAILURE for reward, *_ in results] == touched
    assert env.world.position[0] < 0.3
    assert not any(info["is_success"] for *_, info in results)


def test_both_adapters_tell_the_touch():
    env = DynmapBatchedEnv("balance_reaching_obstacle", num_envs=2)
    env.reset(TensorDict({"scene_seed": torch.tensor([0, 1])}, [2]))
    env.worlds[0] = TASK.make_world(ACROSS.replace(obstacle_x=0.2))
    step = env.step(TensorDict({"action": torch.zeros(2, 3)}, [2]))["next"]
    for key in ("touched", "terminated", "done"):
        assert step[key].flatten().tolist() == [True, False]


def test_reward_is_higher_along_the_way_than_into_the_obstacle():
    around, straight = TASK.make_world(ACROSS), TASK.make_world(ACROSS)
    way = way_around(ACROSS, (0.2, 0.5), (0.8, 0.5))
    rewards = [[], []]
    for _ in range(30):
        rewards[0].append(move(around, towards(around, way[1])))
        rewards[1].append(move(straight, towards(straight, way[-1])))
    assert around.touched == set() and straight.touched
    assert not around.dropped
    untouched = rewards[1].index(FAILURE)
    assert sum(rewards[0][:untouched]) > sum(rewards[1][:untouched])
    assert min(rewards[0][untouched:]) > max(rewards[1][untouched:]) == FAILURE


def test_reward_grows_along_the_way():
    """Of resting worlds, so that only the distance counts."""
    way = way_around(ACROSS, (0.2, 0.5), (0.8, 0.5))
    assert len(way) == 4
    rewards = []
    for start, end in pairwise(way):
        for x, y in np.linspace(start, end, 5)[1:]:
            world = TASK.make_world(ACROSS.replace(cart_x=float(x), cart_y=float(y)))
            world.step(STILL)
            rewards.append(TASK.reward(world))
    assert rewards == sorted(rewards)
    assert rewards[-1] == pytest.approx(1.0, abs=1e-3)


def test_reward_of_moving_away_is_less_than_of_resting():
    away, still, nearer = (TASK.make_world(ACROSS.replace(obstacle_y=0.9)) for _ in range(3))
    rewards = [move(away, (-0.1, 0)), move(still, (0, 0)), move(nearer, (0.1, 0))]
    assert rewards == sorted(rewards) and rewards[0] < rewards[1] < rewards[2]


def test_state_shows_a_way_that_leads_to_the_goal():
    """A cart that always goes where the first two numbers of its state point comes to the goal untouched."""
    blocked = 0
    for seed in range(16):
        scene = TASK.sample_scene(np.random.default_rng(seed))
        if not path_is_blocked(scene):
            continue
        blocked += 1
        world = TASK.make_world(scene)
        for _ in range(EPISODE_STEPS):
            move(world, towards(world, world.position[:2] + TASK.state(world)[:2] / 2, speed=0.3))
        assert world.touched == set() and not world.dropped
        assert world.goal_distance < 0.02
    assert blocked > 3


def test_state_tells_obstacle_and_length_of_the_way():
    scene = ACROSS.replace(obstacle_x=0.45, obstacle_y=0.6, obstacle_length=0.24)
    state = TASK.state(TASK.make_world(scene))
    np.testing.assert_allclose(state[16:19], [0.5, 0.2, 0.2], atol=1e-6)
    assert state[19] == pytest.approx(2 * length(way_around(scene, (0.2, 0.5), (0.8, 0.5))))
    assert state[19] > 1.2 * 1.05
    free = TASK.state(TASK.make_world(scene.replace(obstacle_y=0.95)))
    np.testing.assert_allclose(free[[0, 1, 19]], [1.2, 0.0, 1.2], atol=1e-6)


def test_obstacle_stands_in_the_centre_by_default_and_elsewhere_by_ranges():
    scene = TASK.sample_scene(np.random.default_rng(0))
    assert (scene.obstacle_x, scene.obstacle_y, scene.obstacle_length) == (0.5, 0.38, 0.22)
    ranges = ObstacleRanges(obstacle_x=(0.3, 0.4), obstacle_length=(0.1, 0.15))
    for seed in range(20):
        scene = TASK.sample_scene(np.random.default_rng(seed), ranges)
        assert 0.3 <= scene.obstacle_x <= 0.4 and 0.1 <= scene.obstacle_length <= 0.15


def test_ranges_without_a_clear_start_raise():
    ranges = ObstacleRanges(cart_x=(0.5, 0.5), cart_y=(0.5, 0.5))
    with pytest.raises(ValueError, match="widen"):
        TASK.sample_scene(np.random.default_rng(0), ranges)
