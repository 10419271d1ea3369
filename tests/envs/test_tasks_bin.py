"""Task 3: what counts is that the block falls into the bin and comes to rest there."""

import numpy as np
import pymunk
import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.envs.gym_env import DynmapEnv
from dynmap_rl.envs.scene import BinScene
from dynmap_rl.envs.substeps import read_bodies
from dynmap_rl.envs.tasks import FAILURE, get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import GRAVITY, World

TASK = get_task("bin_dropping")
SCENE = BinScene(cart_x=0.2, cart_y=0.6, goal_x=0.7, goal_y=0.2, bin_width=0.28, bin_depth=0.12)
STILL = np.zeros(3)
DOWN = np.array([0.0, -0.02, 0.0])


def release(x: float, y: float = 0.4, tilt: float = 0.0, scene: BinScene = SCENE) -> World:
    """The block at rest in the air, away from the cart."""
    world = TASK.make_world(scene)
    world.block.position = (x, y)
    world.block.angle = tilt
    return world


def watch(world: World, steps: int = 60) -> list[dict]:
    rows = []
    for _ in range(steps):
        world.step(STILL)
        speed = float(np.hypot(*world.velocity[3:5]))
        rows.append({"success": TASK.is_success(world), "over": TASK.is_over(world), "speed": speed})
        rows[-1]["reward"] = TASK.reward(world)
    return rows


@pytest.mark.parametrize("shift", [0.0, -0.08, 0.08])
@pytest.mark.parametrize("tilt", [0.0, 0.5, 1.5])
def test_block_released_above_the_bin_ends_in_it(shift, tilt):
    world = release(SCENE.goal_x + shift, tilt=tilt)
    rows = watch(world, 90)
    assert not rows[0]["success"]
    assert all(row["speed"] < 0.02 for row in rows if row["success"])
    assert all(row["success"] for row in rows[-10:])
    assert not any(row["over"] for row in rows)
    x, y = world.position[3:5]
    assert abs(x - SCENE.goal_x) < SCENE.bin_width / 2 and SCENE.goal_y - SCENE.bin_depth < y < SCENE.goal_y
    assert world.touched == {"block"} and world.dropped
    assert rows[-1]["reward"] == pytest.approx(1.0, abs=0.01)


def test_no_success_while_the_block_falls():
    """Neither above the bin nor, slow as it may still be, within it."""
    above, within = release(0.7, y=0.5), release(0.7, y=0.18, tilt=np.pi / 2)
    fall = np.sqrt(2 * (0.5 - 0.16) / GRAVITY)  # seconds until it stands on the floor
    assert not any(row["success"] for row in watch(above, int(fall / 0.05) + 1))
    [first] = watch(within, 1)
    assert TASK.is_in_bin(within) and not first["success"]
    assert watch(within, 40)[-1]["success"]


def test_no_success_where_the_block_only_turns_back():
    """At rest for a moment, as at the top of a bounce."""
    world = release(0.7, y=0.13, tilt=np.pi / 2)
    world.block.velocity = (0.0, GRAVITY * 0.1)
    watch(world, 2)
    assert np.hypot(*world.velocity[3:5]) < 0.02 and TASK.is_in_bin(world)
    assert not TASK.is_success(world)


def test_no_success_while_the_block_is_carried():
    """Although it is at rest and below the rim, on a cart that a wide bin has room for."""
    sizes = {"cart_width": 0.20, "block_height": 0.12, "bin_width": 0.32, "bin_depth": 0.13}
    world = TASK.make_world(SCENE.replace(cart_x=0.7, cart_y=0.5, **sizes))
    way = 0.5 - 0.105  # to where the cart's centre is 35 mm above the floor
    path = way * (1 - np.cos(np.linspace(0, np.pi, 90))) / 2
    for dy in np.diff(path):
        world.step([0.0, -dy, 0.0])
    rows = watch(world, 20)
    assert TASK.is_in_bin(world) and rows[-1]["speed"] < 0.002
    assert world.touched == set() and not world.dropped
    assert not any(row["success"] for row in rows)


@pytest.mark.parametrize("x", [0.48, 0.92])
def test_block_that_falls_beside_has_missed(x):
    rows = watch(release(x))
    assert not rows[0]["over"]
    over = [row["over"] for row in rows]
    first = over.index(True)
    assert over == [False] * first + [True] * (len(rows) - first)
    assert not any(row["success"] for row in rows)
    assert all((row["reward"] == FAILURE / 4) is row["over"] for row in rows)


def test_a_drop_alone_is_no_failure():
    world = release(0.7, y=0.6)
    world.step(STILL)
    assert world.dropped
    assert not TASK.is_over(world)


@pytest.mark.parametrize("over_it", [0.0, -0.15, 0.15])
def test_cart_that_touches_the_bin_fails_for_good(over_it):
    world = release(0.7, tilt=1.5, scene=SCENE.replace(cart_x=SCENE.goal_x + over_it))
    world.block.position = (0.7, 0.14)
    assert watch(world, 20)[-1]["success"]
    while "cart" not in world.touched:
        assert world.steps < 100 and not TASK.is_over(world)
        world.step(DOWN)
    for action in [STILL] * 2 + [-DOWN] * 30:
        world.step(action)
        assert TASK.is_over(world)
        assert not TASK.is_success(world)
        assert TASK.reward(world) == FAILURE / 4
    assert world.position[1] > 0.3


def test_both_adapters_end_the_episode():
    options = SCENE.replace(cart_x=0.7, cart_y=0.25).to_dict()
    env = DynmapEnv("bin_dropping")
    env.reset(options=options)
    ends = [env.step(DOWN)[2] for _ in range(10)]
    batched = DynmapBatchedEnv("bin_dropping", num_envs=1)
    batched.reset(TensorDict({"scene_seed": torch.tensor([0])}, [1]))
    batched.worlds[0] = TASK.make_world(BinScene.from_dict(options))
    action = TensorDict({"action": torch.tensor(DOWN, dtype=torch.float32)[None]}, [1])
    steps = [batched.step(action.clone())["next"] for _ in range(10)]
    assert [step["terminated"].item() for step in steps] == ends
    assert [step["touched"].item() for step in steps] == ends
    assert not ends[0] and ends[-1]


def test_reward_grows_as_the_block_comes_near():
    distances = (0.5, 0.3, 0.1, 0.02)
    rewards = []
    for distance in distances:
        world = release(0.7, y=0.2 + distance)
        world.position = np.array(read_bodies(world.cart, world.block)[:6])
        rewards.append(TASK.reward(world))
    assert rewards == sorted(rewards)
    assert 0 < rewards[0] < rewards[-1] <= 0.2


def test_reward_in_the_bin_is_less_for_a_moving_or_tilted_cart():
    still, moving, tilted = (release(0.7, y=0.14, tilt=np.pi / 2) for _ in range(3))
    for world in (still, moving, tilted):
        watch(world, 20)
    for _ in range(4):
        still.step(STILL)
        moving.step([0.01, 0.0, 0.0])
    for action in (0.01, 0.02, 0.03, 0.02, 0.01, 0.0, 0.0):
        tilted.step([0.0, 0.0, action])
    assert TASK.reward(moving) < TASK.reward(still)
    assert TASK.reward(tilted) < TASK.reward(still)


@pytest.mark.parametrize("seed", range(5))
def test_goal_is_the_middle_of_the_opening(seed):
    """Rays from below the goal meet the walls at half the width, the floor at the depth, and nothing above."""
    scene = TASK.sample_scene(np.random.default_rng(seed))
    scene = scene.replace(cart_x=float(scene.goal_x < 0.5), cart_y=0.95)  # out of the way
    world = TASK.make_world(scene)
    x, y = TASK.goal(world)

    def ray(dx: float, dy: float, from_y: float):
        ends = (x, from_y), (x + dx, from_y + dy)
        return world.space.segment_query_first(*ends, 0, pymunk.ShapeFilter())

    half = scene.bin_width / 2
    assert ray(-1, 0, y - 0.02).point.x == pytest.approx(x - half, abs=1e-6)
    assert ray(1, 0, y - 0.02).point.x == pytest.approx(x + half, abs=1e-6)
    assert ray(0, -1, y - 0.02).point.y == pytest.approx(y - scene.bin_depth, abs=1e-6)
    assert ray(0, 1, y - 0.02) is None
    assert ray(-1, 0, y + 1e-4) is None and ray(1, 0, y + 1e-4) is None
    assert ray(-1, 0, y - 0.005) is not None and ray(1, 0, y - 0.005) is not None


def test_state_tells_the_goal_from_the_block_and_the_bins_size():
    world = TASK.make_world(SCENE.replace(bin_width=0.3, bin_depth=0.1, block_shift=0.02))
    block_x, block_y = 0.22, 0.6 + 0.02 + 0.08
    expected = [2 * (0.7 - block_x), 2 * (0.2 - block_y), 0.4, -0.4]
    np.testing.assert_allclose(TASK.state(world)[16:], expected, atol=1e-6)


def test_inside_of_the_bin_is_in_the_picture_and_the_cart_above_it():
    for seed in range(100):
        scene = TASK.sample_scene(np.random.default_rng(seed))
        left, right = (scene.goal_x + side * (scene.bin_width / 2 + 0.02) for side in (-1, 1))
        assert left >= 0 and right <= 1
        assert scene.goal_y - scene.bin_depth >= 0
        assert scene.cart_y - scene.cart_height / 2 > scene.goal_y
