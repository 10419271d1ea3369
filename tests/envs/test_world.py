"""The laws of the simulated world: mechanics, the cart's limits, what counts as a drop."""

import numpy as np
import pytest

from dynmap_rl.envs.scene import Scene
from dynmap_rl.envs.world import (
    ACCELERATION_LIMIT,
    ACTION_LIMIT,
    CONTROL_DT,
    EPISODE_STEPS,
    GRAVITY,
    VELOCITY_LIMIT,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    World,
    simulate,
)

STILL = np.zeros(3)


def push(world: World, acceleration: float, seconds: float) -> np.ndarray:
    """Accelerate the cart along x past all its limits; the last state's ``[6]`` velocity."""
    for i in range(round(seconds / CONTROL_DT)):
        speed = acceleration * CONTROL_DT * np.array([i, i + 1])
        [found] = simulate([world], *(np.array([[x, 0, 0]]) for x in speed))
    return found[6:]


def play(world: World, actions: np.ndarray) -> np.ndarray:
    """Position, velocity and acceleration after every step, ``[T, 18]``."""
    rows = []
    for action in actions:
        world.step(action)
        rows.append(np.concatenate([world.position, world.velocity, world.acceleration]))
    return np.array(rows)


def smooth_actions(seed: int = 0, steps: int = 40) -> np.ndarray:
    """A wave in every axis, gentle enough for the block to stay on the cart."""
    phase = np.random.default_rng(seed).uniform(0, np.pi, 3)
    t = np.arange(steps)[:, None] * CONTROL_DT
    return np.array([0.01, 0.01, 0.01]) * np.sin(2 * t + phase) * np.minimum(1, 2 * t)


# Mechanics


@pytest.mark.parametrize("width, height", [(0.06, 0.12), (0.06, 0.20), (0.04, 0.16), (0.08, 0.16)])
@pytest.mark.parametrize("direction", [-1, 1])
def test_block_tips_at_gravity_times_width_over_height(width, height, direction):
    threshold = GRAVITY * width / height

    def tips(acceleration):
        world = World(Scene(block_width=width, block_height=height, friction=1.0))
        push(world, direction * acceleration, seconds=2.0)
        return abs(world.block.angle) > 0.1

    assert not tips(0.98 * threshold)
    assert tips(1.02 * threshold)


@pytest.mark.parametrize("width, height", [(0.06, 0.20), (0.08, 0.16)])
def test_block_tips_about_its_edge_with_the_moment_of_a_box(width, height):
    acceleration = 2 * GRAVITY * width / height
    expected = 1.5 * (acceleration * height - GRAVITY * width) / (width**2 + height**2)
    world = World(Scene(block_width=width, block_height=height, friction=1.0))
    assert push(world, acceleration, CONTROL_DT)[5] / CONTROL_DT == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("friction", [0.05, 0.1, 0.2])
def test_block_slips_at_friction_times_gravity(friction):
    def block_acceleration(acceleration):
        world = World(Scene(friction=friction, cart_width=2.0, block_width=0.12))
        return push(world, acceleration, seconds=0.5)[3] / 0.5

    assert block_acceleration(0.98 * friction * GRAVITY) == pytest.approx(
        0.98 * friction * GRAVITY, rel=0.005
    )
    assert block_acceleration(1.5 * friction * GRAVITY) == pytest.approx(friction * GRAVITY, rel=0.02)


def test_block_in_the_air_falls_freely():
    world = World(Scene(cart_y=0.1))
    world.block.position = world.block.local_to_world((0.0, 0.5))
    for step in range(1, 4):
        world.step(STILL)
        np.testing.assert_allclose(world.acceleration, [0, 0, 0, 0, -GRAVITY, 0], atol=1e-9)
        np.testing.assert_allclose(world.velocity[4], -GRAVITY * CONTROL_DT * step)


@pytest.mark.parametrize("block_shift", [0.0, -0.04])
def test_resting_block_rests(block_shift):
    world = World(Scene(block_height=0.2, block_shift=block_shift))
    start = world.position
    rows = play(world, np.zeros((EPISODE_STEPS, 3)))
    np.testing.assert_allclose(rows[:, :6], np.tile(start, (EPISODE_STEPS, 1)), atol=2e-4)
    assert np.abs(rows[:, 6:12]).max() < 0.01
    assert world.block.kinetic_energy < 1e-9
    assert not world.dropped


def test_carried_block_neither_sinks_in_nor_lifts_off():
    world = World(Scene(cart_height=0.04, block_height=0.16))
    for action in smooth_actions(steps=EPISODE_STEPS):
        world.step(action)
        assert world.block_in_cart[1] == pytest.approx(0.1, abs=5e-4)
        assert world.block_in_cart[2] == pytest.approx(0.0, abs=5e-3)


def test_mirrored_world_moves_mirrored():
    scene = Scene(cart_x=0.4, block_shift=0.03)
    mirrored = scene.replace(cart_x=0.6, goal_x=0.3, block_shift=-0.03)
    actions = smooth_actions()
    position = play(World(scene), actions)[:, :6]
    mirror = play(World(mirrored), actions * [-1, 1, -1])[:, :6] * [-1, 1, -1, -1, 1, -1]
    mirror[:, [0, 3]] += 1.0
    np.testing.assert_allclose(mirror, position, atol=2e-4)
    assert np.ptp(position[:, 5]) > 0.05


# The cart


def test_cart_follows_the_command_on_parabolas():
    world = World(Scene())
    for action in smooth_actions():
        world.step(action)
        np.testing.assert_allclose(world.position[:3], world.commanded - world.action / 2, atol=1e-9)
        np.testing.assert_allclose(world.velocity[:3], world.action / CONTROL_DT, atol=1e-12)


def test_cart_acceleration_is_the_second_difference_of_commands():
    world = World(Scene())
    commands = [world.commanded, world.commanded]
    for action in smooth_actions():
        world.step(action)
        commands.append(world.commanded)
        second = commands[-1] - 2 * commands[-2] + commands[-3]
        np.testing.assert_allclose(world.acceleration[:3], second / CONTROL_DT**2, atol=1e-9)


def test_gentle_actions_are_executed_as_they_are():
    world = World(Scene())
    for action in smooth_actions():
        world.step(action)
        np.testing.assert_array_equal(world.action, action.astype(np.float32))


@pytest.mark.parametrize("seed", range(3))
def test_limits_hold_for_wild_actions(seed):
    rng = np.random.default_rng(seed)
    world, before = World(Scene()), np.zeros(3)
    for action in rng.normal(size=(EPISODE_STEPS, 3)) * rng.choice([0.01, 1, 100], (EPISODE_STEPS, 1)):
        world.step(action)
        assert (np.abs(world.action) <= ACTION_LIMIT + 1e-8).all()
        assert (np.abs(world.action - before) <= ACCELERATION_LIMIT * CONTROL_DT**2 + 1e-8).all()
        before = world.action


@pytest.mark.parametrize("x", [-1, 1])
@pytest.mark.parametrize("y", [-1, 1])
def test_cart_brakes_at_the_edge_of_the_workspace(x, y):
    tolerance = ACCELERATION_LIMIT * CONTROL_DT**2 / 8 + 1e-6  # the last braking step need not be a whole one
    world = World(Scene())
    for _ in range(EPISODE_STEPS):
        world.step(np.array([x, y, x * y], dtype=float))
        assert (world.commanded >= WORKSPACE_LOW - tolerance).all()
        assert (world.commanded <= WORKSPACE_HIGH + tolerance).all()
        assert (np.abs(world.acceleration[:3]) <= ACCELERATION_LIMIT + 1e-4).all()
    edge = np.where(np.array([x, y, x * y]) > 0, WORKSPACE_HIGH, WORKSPACE_LOW)
    assert (np.abs(world.commanded - edge) <= tolerance).all()
    np.testing.assert_allclose(world.velocity[:3], 0, atol=1e-3)


def test_full_speed_is_reached():
    world = World(Scene())
    for _ in range(10):
        world.step(np.array([1.0, 0.0, 0.0]))
    assert world.velocity[0] == pytest.approx(VELOCITY_LIMIT[0])


def test_both_interfaces_give_the_same_trajectory():
    rng = np.random.default_rng(0)
    by_acceleration, by_position = World(Scene()), World(Scene())
    for acceleration in rng.uniform(-1, 1, (40, 3)) * ACCELERATION_LIMIT:
        by_acceleration.accelerate(acceleration)
        by_position.step(by_acceleration.action)
        np.testing.assert_array_equal(by_acceleration.position, by_position.position)
        np.testing.assert_array_equal(by_acceleration.velocity, by_position.velocity)


def test_acceleration_interface_gives_that_acceleration():
    world = World(Scene())
    for acceleration in ([1.0, -0.5, 2.0], [-1.0, 2.0, -3.0]):
        world.accelerate(np.array(acceleration))
        np.testing.assert_allclose(world.acceleration[:3], acceleration, atol=1e-5)


# Read-out and replay


def test_acceleration_is_the_difference_of_velocities():
    world, before = World(Scene()), np.zeros(6)
    np.testing.assert_array_equal(world.acceleration, np.zeros(6))
    for action in smooth_actions():
        world.step(action)
        np.testing.assert_array_equal(world.acceleration, (world.velocity - before) / CONTROL_DT)
        before = world.velocity


def test_replay_of_executed_actions_is_bit_exact():
    rng = np.random.default_rng(1)
    world, executed, rows = World(Scene()), [], []
    for action in rng.normal(size=(60, 3)) * 0.01:
        rows.append(play(world, [action])[0])
        executed.append(world.action.astype(np.float32))
    np.testing.assert_array_equal(play(World(Scene()), executed), rows)


def test_position_error_is_the_mean_of_the_last_ten_distances():
    world = World(Scene(cart_x=0.3, cart_y=0.2, goal_x=0.6, goal_y=0.6))
    assert world.position_error == pytest.approx(0.5)
    distances = []
    for action in smooth_actions(steps=25):
        world.step(action)
        distances.append(np.hypot(*(world.position[:2] - [0.6, 0.6])))
        assert world.position_error == pytest.approx(np.mean(distances[-10:]))


@pytest.mark.parametrize(
    "action", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0], [0, 0, 0, 0], [[0, 0, 0]], 0.0, ["a", "b", "c"]]
)
def test_invalid_action_raises_and_leaves_the_world_alone(action):
    world = World(Scene())
    with pytest.raises(ValueError):
        world.step(action)
    assert world.steps == 0


# Drops


def place(x: float, y: float, tilt: float) -> World:
    """A world with the block at a pose relative to the cart, one step later."""
    world = World(Scene(cart_width=0.25, cart_height=0.04, block_height=0.16, cart_y=0.4))
    world.block.position = world.cart.local_to_world((x, y))
    world.block.angle = tilt
    world.step(STILL)
    return world


@pytest.mark.parametrize(
    "x, y, tilt, dropped",
    [
        (0.0, 0.2, 0.0, False),
        (0.12, 0.2, 0.0, False),
        (0.13, 0.2, 0.0, True),  # beyond the edge
        (-0.13, 0.2, 0.0, True),
        (0.0, 0.2, 0.7, False),
        (0.0, 0.2, 0.9, True),  # leaning over by more than 45 degrees
        (0.0, 0.2, -0.9, True),
        (0.0, -0.2, 0.0, True),  # below
    ],
)
def test_drop_is_detected(x, y, tilt, dropped):
    assert place(x, y, tilt).dropped is dropped


def test_tilt_counts_relative_to_the_cart():
    world = World(Scene(cart_y=0.4))
    world.cart.angle = 0.6
    world.block.position = world.cart.local_to_world((0.0, 0.2))
    world.block.angle = 0.9
    world.step(STILL)
    assert not world.dropped


def test_drop_latches():
    world = place(0.13, 0.2, 0.0)
    world.block.position = world.cart.local_to_world((0.0, 0.1))
    world.block.velocity = (0.0, 0.0)
    world.step(STILL)
    assert world.block_in_cart[1] == pytest.approx(0.1, abs=1e-3)
    assert world.dropped


def test_hard_braking_drops_a_tall_block():
    world = World(Scene(block_height=0.2))
    for i in range(EPISODE_STEPS):
        world.accelerate([3.0 if i // 4 % 2 else -3.0, 0.0, 0.0])
    assert world.dropped
    assert world.position[4] < world.position[1]
