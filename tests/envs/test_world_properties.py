"""Laws that hold in every scene and under any action, on random episodes of each task."""

import math
from dataclasses import asdict

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.world import (
    ACCELERATION_LIMIT,
    ACTION_LIMIT,
    CONTROL_DT,
    GRAVITY,
    SUBSTEPS,
    VELOCITY_LIMIT,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    World,
)

STANDS = 0.001  # rad, a larger tilt is a block that rocks
EDGE = ACCELERATION_LIMIT * CONTROL_DT**2 / 8 + 1e-6  # the last braking step need not be a whole one


def make_world(name: str, seed: int) -> tuple[World, np.random.Generator]:
    rng = np.random.default_rng(seed)
    return get_task(name).make_world(get_task(name).sample_scene(rng)), rng


def wild(rng: np.random.Generator, wildness: float) -> np.ndarray:
    return wildness * ACTION_LIMIT * rng.standard_normal(3)


def all_is_finite_and_the_cart_within_its_limits(name, seed, wildness):
    world, rng = make_world(name, seed)
    for _ in range(120):
        world.step(wild(rng, wildness))
        assert np.isfinite([world.position, world.velocity, world.acceleration]).all()
        assert (np.abs(world.velocity[:3]) <= VELOCITY_LIMIT + 1e-6).all()
        assert (world.position[:3] >= WORKSPACE_LOW - EDGE).all()
        assert (world.position[:3] <= WORKSPACE_HIGH + EDGE).all()


def top_speeds(world: World) -> tuple[float, float]:
    """Of the fastest points of cart and block (m/s)."""
    s, v = world.scene, world.velocity
    cart, block = math.hypot(s.cart_width, s.cart_height) / 2, math.hypot(s.block_width, s.block_height) / 2
    return math.hypot(*v[:2]) + abs(v[2]) * cart, math.hypot(*v[3:5]) + abs(v[5]) * block


def the_block_does_not_sink_into_what_it_touches(name, seed, wildness):
    """But as deep as it moves in a substep of 1 ms, of which the solver takes back a quarter in a control step; and
    where the cart, which nothing stops, presses it against something else, as far as the cart goes."""
    world, rng = make_world(name, seed)
    [block] = world.block.shapes
    left = world.space.collision_bias**CONTROL_DT
    sunk, depths, before = 0.0, [], top_speeds(world)
    for _ in range(120):
        world.step(wild(rng, wildness))
        after = top_speeds(world)
        cart, own = np.maximum(before, after)
        before = after
        hit = (cart + own + GRAVITY * CONTROL_DT) * CONTROL_DT / SUBSTEPS
        touched = world.space.shape_query(block)
        pressed = len({info.shape for info in touched}) > 1
        sunk = max(sunk, hit) + cart * CONTROL_DT if pressed else max(left * sunk, hit)
        found = [-point.distance for info in touched for point in info.contact_point_set.points]
        assert max(found, default=0) < world.space.collision_slop + sunk
        depths += [] if pressed else found
    assert np.median(depths) < 3 * world.space.collision_slop


def what_has_come_to_rest_stays_at_rest(name, seed, wildness):
    """Standing or fallen: its energy does not rise again."""
    world, rng = make_world(name, seed)
    for _ in range(30):
        world.step(wild(rng, wildness))
    for _ in range(400):
        before = world.position
        world.step(np.zeros(3))
        # The solver lifts what sank in out again without a velocity.
        if max(np.abs(world.velocity).max(), np.abs(world.position - before).max()) < 1e-6:
            break
    else:
        raise AssertionError("it never comes to rest")
    heights = []
    for _ in range(60):
        world.step(np.zeros(3))
        speed, turn = np.hypot(*world.velocity[3:5]), world.velocity[5]
        kinetic = speed**2 / 2 + world.block.moment / world.block.mass * turn**2 / 2
        heights.append(world.position[4] + kinetic / GRAVITY)  # that all the energy would lift the block to
    assert max(heights) < heights[0] + 1e-5


def the_mirrored_world_moves_mirrored(name, seed, wildness):
    """With its walls: wherever the block stands, until it is dropped.

    Contacts are solved in another order, and a block that rocks lands at another moment. One that stands in both worlds
    differs by two tilts and what it may sink in, at its corners, 0.1 m from its centre.
    """
    world, rng = make_world(name, seed)
    fields = asdict(world.scene)
    places = {key: 1 - value for key, value in fields.items() if key.endswith("_x")}
    mirrored = get_task(name).make_world(world.scene.replace(**places, block_shift=-fields["block_shift"]))
    mirror, compared = np.array([-1, 1, -1]), 0
    tolerance = 2 * STANDS * 0.1 + world.space.collision_slop
    for _ in range(60):
        action = wild(rng, wildness)
        world.step(action)
        mirrored.step(action * mirror)
        if world.dropped or mirrored.dropped:
            break
        expected = world.position * np.tile(mirror, 2) + [1, 0, 0, 1, 0, 0]
        np.testing.assert_allclose(mirrored.position[:3], expected[:3], atol=1e-12)
        if max(abs(world.block_in_cart[2]), abs(mirrored.block_in_cart[2])) < STANDS:
            np.testing.assert_allclose(mirrored.position[3:5], expected[3:5], rtol=0, atol=tolerance)
            compared += 1
    assume(compared >= 20)


LAWS = {  # with the range of sizes of random actions, in units of their limits
    all_is_finite_and_the_cart_within_its_limits: (0.05, 4),
    the_block_does_not_sink_into_what_it_touches: (0.05, 4),
    what_has_come_to_rest_stays_at_rest: (0.05, 4),
    the_mirrored_world_moves_mirrored: (0.02, 0.15),
}


@pytest.mark.parametrize("examples", [4, pytest.param(90, marks=pytest.mark.stress)])
@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_law(law, name, examples):
    @settings(max_examples=examples, deadline=None, derandomize=True)
    @given(seed=st.integers(0, 2**32 - 1), wildness=st.floats(*LAWS[law]))
    def hold(seed, wildness):
        law(name, seed, wildness)

    hold()
