"""Scenes: drawn from their ranges, determined by the seed, every factor fixable."""

from dataclasses import fields
from itertools import pairwise

import numpy as np
import pytest

from dynmap_rl.envs.scene import SEEDS_PER_SPLIT, SPLITS, Scene, SceneRanges, sample_scene, scene_seed

NUMBERS = [f.name for f in fields(Scene) if not f.name.endswith("color")]


def scenes(ranges: SceneRanges | None = None, count: int = 200) -> list[Scene]:
    return [sample_scene(np.random.default_rng(seed), ranges) for seed in range(count)]


def test_seed_determines_the_scene():
    assert scenes(count=50) == scenes(count=50)
    assert len(set(scenes(count=50))) == 50


@pytest.mark.parametrize(
    "ranges",
    [
        SceneRanges(),
        SceneRanges(
            cart_width=(0.4, 0.5), friction=(0.2, 0.9), object_color=(0, 50), background_color=(90, 99)
        ),
    ],
)
def test_ranges_are_respected_and_filled(ranges):
    drawn = scenes(ranges)
    for name in NUMBERS:
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


def test_start_is_away_from_the_goal_and_objects_differ():
    for scene in scenes():
        assert np.hypot(scene.cart_x - scene.goal_x, scene.cart_y - scene.goal_y) >= 0.2
        assert np.linalg.norm(np.subtract(scene.cart_color, scene.block_color)) >= 60


def test_impossible_ranges_raise():
    with pytest.raises(ValueError, match="widen"):
        sample_scene(np.random.default_rng(0), SceneRanges(min_distance=2.0))
    with pytest.raises(ValueError, match="min_contrast"):
        sample_scene(np.random.default_rng(0), SceneRanges(min_contrast=500.0))


def test_splits_never_share_a_seed():
    ends = sorted((scene_seed(s, 0), scene_seed(s, SEEDS_PER_SPLIT - 1)) for s in SPLITS)
    assert all(last < first for (_, last), (first, _) in pairwise(ends))
    assert scene_seed("test", 5) == scene_seed("test", 4) + 1


@pytest.mark.parametrize("split, index", [("nope", 0), ("test", -1), ("test", SEEDS_PER_SPLIT)])
def test_unknown_split_or_index_raises(split, index):
    with pytest.raises(ValueError, match="scene index|unknown split"):
        scene_seed(split, index)


def test_every_factor_can_be_fixed():
    drawn = scenes(count=2)
    assert drawn[0].replace(**drawn[1].to_dict()) == drawn[1]
    assert Scene().replace(block_color=[1, 2, 3]).block_color == (1, 2, 3)


def test_scene_survives_its_dict():
    scene = scenes(count=1)[0]
    assert Scene.from_dict(scene.to_dict()) == scene


def test_unknown_factor_raises():
    with pytest.raises(ValueError, match="cart_z"):
        Scene().replace(cart_z=0.1)


@pytest.mark.parametrize("factor", [{"block_width": 0.0}, {"density": -1.0}, {"block_shift": 0.2}])
def test_impossible_scene_raises(factor):
    with pytest.raises(ValueError, match=next(iter(factor))):
        Scene(**factor)
