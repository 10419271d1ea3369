"""The tasks of the benchmarks: their experts, what is drawn, and what is a success."""

from types import SimpleNamespace

import numpy as np
import pytest
from own_task import check_renderer

from dynmap_rl.envs.tasks import get_task

SEEDS = range(6, 18)


def make(name):
    check_renderer()
    pytest.importorskip("gymnasium_robotics" if "Fetch" in name else "metaworld")
    return get_task(f"mujoco:{name}")


def project(world, camera, point, size=64):
    """Return column and row of the pixel at which a camera sees a point."""
    azimuth, elevation = np.deg2rad([camera.azimuth, camera.elevation])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0])
    ahead = np.array([*(np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])), np.sin(elevation)])
    away = point - (np.array(camera.lookat) - camera.distance * ahead)
    scale = size / 2 / np.tan(np.deg2rad(world.model.vis.global_.fovy) / 2) / (away @ ahead)
    return size / 2 + scale * np.array([away @ right, -(away @ np.cross(right, ahead))])


def find_middle(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) + 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "expected"), [("FetchPush", 12), ("FetchSlide", 11), ("PlateSlide", 12), ("Soccer", 10)]
)
def test_the_experts_of_the_benchmarks_succeed(name, expected):
    task = make(name)
    draw, world, solved, beyond = task.make_renderer(), None, 0, []
    for seed in SEEDS:
        world = task.begin(seed, None, world)
        assert not task.is_success(world) and world.position_error > 0.05
        first, act = draw(world), task.demonstrator(world)
        for _ in range(task.layout.steps):
            action = act()
            assert np.abs(action).max() <= 1
            task.step([world], [action])
        solved += task.is_success(world)
        assert not world.dropped and (draw(world) != first).any()
        beyond.append(world.position[0] - task.goal(world)[0])
    assert solved >= expected
    if name == "FetchSlide":  # launches are neither too short nor too long
        assert abs(np.mean(beyond)) < 0.01


def test_a_push_is_corrected_sideways():
    make("FetchPush")
    from dynmap_rl.envs.mujoco.fetch_experts import PushExpert

    for side in (-0.01, 0.01):
        world = SimpleNamespace(position=np.array([0, 0, 0.425, -0.06, side, 0.425]))
        x, y = PushExpert(world, np.array([0.2, 0, 0.425]))()[:2]
        assert x > 0.3 and y * side < 0 and abs(y) > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["FetchPush", "FetchSlide"])
def test_the_marker_follows_the_goal_and_no_other_is_drawn(name):
    task, world = make(name), None
    for seed in (0, 2):
        world = task.begin(seed, None, world)
        red, green, blue = np.moveaxis(task.make_renderer()(world).astype(int), -1, 0)
        marker = find_middle(red > 60 + np.maximum(green, blue))
        assert np.abs(marker - project(world, task.cameras[0], task.goal(world))).max() < 1.5
        assert not (green > 20 + np.maximum(red, blue)).any()  # of the hand's target


@pytest.mark.slow
@pytest.mark.parametrize("name", ["PlateSlide", "Soccer"])
def test_the_place_of_the_goal_is_drawn(name):
    frames = []
    for keep in (make(name).keep, ()):
        task = make(name)
        task.keep = keep
        world = task.begin(0)
        frames.append(task.make_renderer()(world).astype(int))
    drawn = np.abs(frames[0] - frames[1]).max(-1) > 20
    assert drawn.sum() > 50
    column = project(world, task.cameras[0], task.goal(world))[0]
    assert abs(find_middle(drawn)[0] - column) < 8


@pytest.mark.slow
@pytest.mark.parametrize(("name", "stays"), [("FetchPush", False), ("PlateSlide", True), ("Soccer", True)])
def test_only_in_meta_world_an_episode_once_solved_stays_a_success(name, stays, monkeypatch):
    task = make(name)
    monkeypatch.setattr(type(task), "is_solved", lambda self, world: world.steps == 1)
    world, seen = task.begin(0), []
    for _ in range(3):
        task.step([world], [np.zeros(4)])
        seen.append(task.is_success(world))
    assert seen == [True, stays, stays]


@pytest.mark.slow
def test_an_object_off_the_table_is_dropped():
    task = make("FetchPush")
    for height, dropped in ((0.45, False), (0.2, True)):
        world = task.begin(0)
        world.data.joint("object0:joint").qpos[:3] = (
            (1.3, 0.75, height) if not dropped else (0.6, 0.2, height)
        )
        task.step([world], [np.zeros(4)])
        assert world.dropped is dropped
