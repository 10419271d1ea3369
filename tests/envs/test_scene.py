"""Scenes: drawn from their ranges, determined by the seed, every factor fixable."""

import json
import math
from dataclasses import fields
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from dynmap_rl.envs.scene import (
    SEEDS_PER_SPLIT,
    SPLITS,
    BinRanges,
    BinScene,
    ObstacleRanges,
    ObstacleScene,
    Scene,
    SceneRanges,
    choose_ranges,
    sample_scene,
    scene_seed,
)

every_kind = pytest.mark.parametrize("ranges", [SceneRanges(), ObstacleRanges(), BinRanges()])


def scenes(ranges: SceneRanges | None = None, count: int = 200) -> list[Scene]:
    return [sample_scene(np.random.default_rng(seed), ranges) for seed in range(count)]


@every_kind
def test_seed_determines_the_scene(ranges):
    assert scenes(ranges, 50) == scenes(ranges, 50)
    assert len(set(scenes(ranges, 50))) == 50


def test_scenes_of_task_1_are_those_of_the_published_results():
    scene = sample_scene(np.random.default_rng(scene_seed("test", 0)))
    assert scene == Scene(
        cart_width=0.23918399024325496,
        cart_height=0.04,
        block_width=0.06,
        block_height=0.16144137880609483,
        block_shift=-0.01563183817184643,
        cart_x=0.370463200863278,
        cart_y=0.5535727611022035,
        goal_x=0.19316864092752445,
        goal_y=0.32173098107919573,
        friction=0.8,
        density=100.0,
        cart_color=(79, 59, 70),
        block_color=(67, 126, 118),
        background_color=(193, 236, 214),
    )


@pytest.mark.parametrize(
    ("ranges", "kind"), [(SceneRanges(), Scene), (ObstacleRanges(), ObstacleScene), (BinRanges(), BinScene)]
)
def test_ranges_draw_scenes_of_their_task(ranges, kind):
    assert {type(scene) for scene in scenes(ranges, 5)} == {kind}


@pytest.mark.parametrize(
    "ranges",
    [
        SceneRanges(),
        SceneRanges(
            cart_width=(0.4, 0.5), friction=(0.2, 0.9), object_color=(0, 50), background_color=(90, 99)
        ),
        ObstacleRanges(obstacle_x=(0.4, 0.6), obstacle_y=(0.3, 0.5), obstacle_length=(0.1, 0.3)),
        BinRanges(),
    ],
)
def test_ranges_are_respected_and_filled(ranges):
    drawn = scenes(ranges)
    for name in [f.name for f in fields(ranges.scene) if not f.name.endswith("color")]:
        low, high = getattr(ranges, name)
        values = np.array([getattr(scene, name) for scene in drawn])
        assert low <= values.min() and values.max() <= high
        assert np.ptp(values) >= 0.8 * (high - low)
    for name, (low, high) in {
        "cart_color": ranges.object_color,
        "block_color": ranges.object_color,
        "background_color": ranges.background_color,
    }.items():
        values = np.array([getattr(scene, name) for scene in drawn])
        assert values.min() == low and values.max() == high


@every_kind
def test_start_is_away_from_the_goal_and_objects_differ(ranges):
    for scene in scenes(ranges):
        assert np.hypot(scene.cart_x - scene.goal_x, scene.cart_y - scene.goal_y) >= 0.2
        assert np.linalg.norm(np.subtract(scene.cart_color, scene.block_color)) >= 60


def test_impossible_ranges_raise():
    with pytest.raises(ValueError, match="widen"):
        sample_scene(np.random.default_rng(0), SceneRanges(min_distance=2.0))
    with pytest.raises(ValueError, match="min_contrast"):
        sample_scene(np.random.default_rng(0), SceneRanges(min_contrast=500.0))


@pytest.mark.parametrize(
    "ranges",
    [
        {"friction": (0.9, 0.1)},
        {"friction": 0.5},
        {"cart_width": (math.nan, 1.0)},
        {"background_color": (255, 180)},
        {"cart_x": (0.5,)},
    ],
)
def test_a_range_is_two_numbers(ranges):
    with pytest.raises(ValueError, match=next(iter(ranges))):
        SceneRanges(**ranges)


@pytest.mark.parametrize(
    ("kind", "ranges"),
    [
        (SceneRanges, {"block_shift": (-0.1, 0.09)}),  # of a cart that is at least 0.2 m wide
        (SceneRanges, {"block_shift": (-0.05, 0.15)}),
        (SceneRanges, {"goal_x": (0.5, 1.2)}),
        (SceneRanges, {"block_width": (0.0, 0.1)}),
        (SceneRanges, {"background_color": (180, 300)}),
        (SceneRanges, {"min_distance": -1.0}),
        (SceneRanges, {"min_contrast": math.nan}),
        (ObstacleRanges, {"obstacle_length": (0.01, 0.2)}),
    ],
)
def test_ranges_that_hold_impossible_scenes_are_refused(kind, ranges):
    kind()
    with pytest.raises(ValueError, match=next(iter(ranges))):
        kind(**({"cart_width": (0.19, 0.3)} | ranges))


def test_splits_never_share_a_seed():
    ends = sorted((scene_seed(s, 0), scene_seed(s, SEEDS_PER_SPLIT - 1)) for s in SPLITS)
    assert all(last < first for (_, last), (first, _) in pairwise(ends))
    assert scene_seed("test", 5) == scene_seed("test", 4) + 1


@pytest.mark.parametrize("split, index", [("nope", 0), ("test", -1), ("test", SEEDS_PER_SPLIT)])
def test_unknown_split_or_index_raises(split, index):
    with pytest.raises(ValueError, match="split|index"):
        scene_seed(split, index)


@every_kind
def test_every_factor_can_be_fixed(ranges):
    drawn = scenes(ranges, 2)
    assert drawn[0].replace(**drawn[1].to_dict()) == drawn[1]
    assert Scene().replace(block_color=[1, 2, 3]).block_color == (1, 2, 3)


@every_kind
def test_scene_survives_its_dict(ranges):
    scene = scenes(ranges, 1)[0]
    assert ranges.scene.from_dict(scene.to_dict()) == scene


def test_unknown_factor_raises():
    with pytest.raises(ValueError, match="cart_z"):
        Scene().replace(cart_z=0.1)


@pytest.mark.parametrize(
    ("kind", "factor"),
    [
        (Scene, {"block_width": 0.0}),
        (Scene, {"density": -1.0}),
        (Scene, {"block_shift": 0.2}),
        (ObstacleScene, {"obstacle_length": 0.0}),
        (ObstacleScene, {"obstacle_length": 0.01}),
        (BinScene, {"bin_width": -0.1}),
        (BinScene, {"bin_depth": 0.0}),
    ],
)
def test_impossible_scene_raises(kind, factor):
    with pytest.raises(ValueError, match=next(iter(factor))):
        kind(**factor)


@pytest.mark.parametrize(
    "factor",
    [
        {"goal_x": 7.0},
        {"cart_y": -0.1},
        {"goal_x": "0.7"},
        {"density": None},
        {"density": math.inf},
        {"friction": -1.0},
        {"block_shift": math.nan},
        {"cart_color": (0.9, 0.9, 0.9)},
        {"block_color": (300, -1, 0)},
        {"background_color": (1, 2)},
        {"cart_color": "red"},
        {"cart_color": 5},
    ],
)
def test_impossible_factors_are_refused(factor):
    with pytest.raises(ValueError, match=next(iter(factor))):
        Scene().replace(**factor)


def test_numbers_of_numpy_are_numbers():
    scene = Scene().replace(goal_x=np.float32(0.5))
    assert scene == Scene(goal_x=0.5) and type(scene.goal_x) is float
    scene = Scene().replace(cart_color=np.array([1, 2, 3]))
    assert scene == Scene(cart_color=(1, 2, 3)) and json.dumps(scene.to_dict())


def test_ranges_are_ranges():
    own = SimpleNamespace(length=(1, 2))  # of a task of one's own
    assert choose_ranges(SimpleNamespace(length=(0, 9)), own) is own
    with pytest.raises(ValueError, match="SceneRanges in this task, got dict"):
        choose_ranges(SceneRanges(), {"density": (1, 2)})
