"""Walls: they stop the block, the cart passes, and every touch is noticed."""

import copy
import pickle

import numpy as np
import pytest
from pymunk import Vec2d

from dynmap_rl.envs.scene import Scene
from dynmap_rl.envs.world import CONTROL_DT, WALL_RADIUS, World

SCENE = Scene(cart_x=0.3, cart_y=0.2, cart_width=0.24, cart_height=0.04, block_height=0.16)
CART_TOP, CART_FRONT = 0.22, 0.42
AT_THE_BLOCK = (0.5, 0.3), (0.5, 0.8)
AT_THE_CART = (0.5, 0.1), (0.5, 0.2)  # its rounded end is 10 mm below the cart's top
FAR_AWAY = (5.0, 5.0), (5.0, 6.0)
STILL = np.zeros(3)


def to_the_right(steps: int = 50, speed: float = 0.2) -> np.ndarray:
    """A gentle start to a constant speed along x, ``[steps, 3]``."""
    ramp = np.minimum(1, np.arange(1, steps + 1) / 10)
    return speed * CONTROL_DT * ramp[:, None] * [1, 0, 0]


def drive(world: World, actions) -> np.ndarray:
    rows = []
    for action in actions:
        world.step(action)
        rows.append(np.concatenate([world.position, world.velocity, world.acceleration]))
    return np.array(rows)


def front_of_block(world: World, above: float) -> float:
    """The largest x of the block's corners higher than this, -inf where there is none."""
    [shape] = world.block.shapes
    corners = [world.block.local_to_world(v) for v in shape.get_vertices()]
    return max((x for x, y in corners if y > above), default=-np.inf)


def test_block_is_stopped_by_a_wall_under_which_the_cart_drives_on():
    free, walled = World(SCENE), World(SCENE, [AT_THE_BLOCK])
    for action in to_the_right():
        free.step(action)
        walled.step(action)
        assert front_of_block(walled, above=0.3) < 0.5 - WALL_RADIUS + 0.002
    np.testing.assert_array_equal(walled.position[:3], free.position[:3])
    assert free.position[3] > 0.7
    assert walled.position[3] < 0.5
    assert walled.touched == {"block"}
    assert not free.dropped and walled.dropped


def test_cart_passes_a_wall_as_if_it_were_not_there():
    free, walled = World(SCENE), World(SCENE, [AT_THE_CART])
    np.testing.assert_array_equal(drive(walled, to_the_right()), drive(free, to_the_right()))
    assert walled.touched == {"cart"}
    assert not walled.dropped


def test_both_are_noticed():
    world = World(SCENE, [AT_THE_CART, AT_THE_BLOCK])
    drive(world, to_the_right())
    assert world.touched == {"cart", "block"}


def test_touch_is_remembered():
    world = World(SCENE, [AT_THE_CART])
    drive(world, to_the_right(steps=30))
    assert world.touched == {"cart"}
    drive(world, -to_the_right(steps=40))
    assert world.position[0] + SCENE.cart_width / 2 < 0.48
    assert world.touched == {"cart"}


@pytest.mark.parametrize("gap, touched", [(0.001, set()), (-0.001, {"cart"})])
@pytest.mark.parametrize("side", ["front", "below"])
def test_a_wall_is_as_thick_as_it_says(side, gap, touched):
    if side == "front":
        x = CART_FRONT + WALL_RADIUS + gap
        wall = (x, 0.0), (x, 0.2)
    else:
        y = CART_TOP - 0.04 - WALL_RADIUS - gap
        wall = (0.0, y), (1.0, y)
    world = World(SCENE, [wall])
    world.step(STILL)
    assert world.touched == touched


def test_touch_shorter_than_a_control_step_is_noticed():
    """Forth and back within one step: before and after it the cart is clear of the wall."""
    wall_x = CART_FRONT + 0.0024 + WALL_RADIUS  # beyond where the step begins, before where the cart turns
    world = World(SCENE, [((wall_x, 0.0), (wall_x, 0.2))])
    forth = np.array([0.075 * CONTROL_DT, 0, 0])
    world.step(forth)
    before = world.position[0]
    assert before + SCENE.cart_width / 2 < wall_x - WALL_RADIUS - 3e-4
    assert world.touched == set()
    world.step(-forth)
    assert world.position[0] == pytest.approx(before, abs=1e-9)
    assert world.touched == {"cart"}


def test_no_walls_no_touch():
    world = World(SCENE)
    drive(world, to_the_right())
    assert world.touched == set()


@pytest.mark.parametrize("speed, dropped", [(0.1, False), (0.4, True)])
def test_world_without_walls_is_that_with_a_wall_far_away(speed, dropped):
    rng = np.random.default_rng(0)
    actions = [speed * CONTROL_DT * rng.choice([-1, 1], 3) * [1, 1, 2.5] for _ in range(60)]
    plain, walled = World(SCENE), World(SCENE, [FAR_AWAY])
    np.testing.assert_array_equal(drive(plain, actions), drive(walled, actions))
    assert walled.touched == set()
    assert walled.dropped is dropped


def test_block_comes_to_rest_on_a_level_wall():
    world = World(SCENE, [((0.5, 0.1), (0.9, 0.1))])
    world.block.position = Vec2d(0.7, 0.3)
    drive(world, [STILL] * 40)
    assert world.position[4] == pytest.approx(0.1 + WALL_RADIUS + 0.16 / 2, abs=1e-3)
    assert np.abs(world.velocity[3:]).max() < 1e-3
    assert world.touched == {"block"}


def test_collisions_are_repeated_bit_by_bit():
    once, again = (drive(World(SCENE, [AT_THE_CART, AT_THE_BLOCK]), to_the_right()) for _ in range(2))
    np.testing.assert_array_equal(once, again)


def test_mirrored_collision_is_mirrored():
    mirrored = SCENE.replace(cart_x=1 - SCENE.cart_x)
    right = drive(World(SCENE, [AT_THE_BLOCK]), to_the_right(25))[:, :6]
    left = drive(World(mirrored, [AT_THE_BLOCK]), -to_the_right(25))[:, :6]
    left *= [-1, 1, -1, -1, 1, -1]
    left[:, [0, 3]] += 1
    np.testing.assert_allclose(left, right, atol=0.01)
    assert right[-1, 5] > 0.5


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda world: pickle.loads(pickle.dumps(world))])
def test_a_copy_has_touches_of_its_own(copied):
    world = World(SCENE, [AT_THE_BLOCK, AT_THE_CART])
    other = copied(world)
    drive(other, to_the_right())
    assert other.touched == {"cart", "block"} and world.touched == set()
    drive(world, to_the_right())
    assert world.touched == other.touched
