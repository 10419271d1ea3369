"""Task 1: its reward, its success, and the state its experts see."""

import numpy as np
import pytest

from dynmap_rl.envs.scene import Scene
from dynmap_rl.envs.tasks import MARKER_SIZE, get_task
from dynmap_rl.envs.world import EPISODE_STEPS, World

TASK = get_task("balance_reaching")
STILL = np.zeros(3)


def world_at(distance: float, **factors) -> World:
    """Goal and cart on one height, so far apart."""
    return World(Scene(cart_x=0.3, cart_y=0.4, goal_x=0.3 + distance, goal_y=0.4, **factors))


def after_episode(world: World) -> World:
    for _ in range(EPISODE_STEPS):
        world.step(STILL)
    return world


def test_unknown_task_names_the_known_ones():
    with pytest.raises(ValueError, match="balance_reaching"):
        get_task("nope")


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


def test_dropped_block_earns_nothing():
    world = world_at(0.0)
    world.dropped = True
    assert TASK.reward(world) == 0


def test_reward_stays_in_its_range_for_wild_actions():
    rng = np.random.default_rng(0)
    for seed in range(3):
        world = World(TASK.sample_scene(np.random.default_rng(seed), None))
        for _ in range(60):
            world.step(rng.normal(size=3))
            assert -0.2 <= TASK.reward(world) <= 1


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


def test_state_is_finite_and_bounded_even_after_a_drop():
    rng = np.random.default_rng(0)
    world = World(Scene(block_height=0.2))
    for _ in range(EPISODE_STEPS):
        world.step(rng.normal(size=3))
        state = TASK.state(world)
        assert state.shape == (TASK.state_size,) and state.dtype == np.float32
        assert (np.abs(state) <= 10).all()
    assert world.dropped


def test_state_of_a_resting_world():
    state = TASK.state(world_at(0.25, cart_width=0.25, block_height=0.16, block_shift=0.02))
    expected = np.zeros(16)
    expected[[0, 2, 3, 8]] = 0.5, -0.4, -0.2, 0.2  # goal, cart, block's shift
    np.testing.assert_allclose(state, expected, atol=1e-6)


def test_state_knows_no_colours():
    plain, red = world_at(0.3), world_at(0.3, cart_color=(200, 0, 0), background_color=(0, 0, 0))
    np.testing.assert_array_equal(TASK.state(plain), TASK.state(red))


def test_marker_is_a_square_at_the_goal():
    scene = Scene(goal_x=0.6, goal_y=0.3)
    [(polygon, _)] = TASK.markers(scene)
    np.testing.assert_allclose(np.mean(polygon, 0), TASK.goal(World(scene)))
    np.testing.assert_allclose(np.ptp(polygon, 0), MARKER_SIZE)
