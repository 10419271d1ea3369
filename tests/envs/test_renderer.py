"""The renderer: 1 m x 1 m on the frame, y upwards, nothing of the world changed."""

import numpy as np
import pygame
import pytest

from dynmap_rl.envs.renderer import Renderer, box
from dynmap_rl.envs.scene import GOAL_COLOR, Scene
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.world import WALL, World

TASK = get_task("balance_reaching")
SCENE = Scene(cart_x=0.3, cart_y=0.3, goal_x=0.8, goal_y=0.7)
PIXEL = 1 / 64


def draw(scene: Scene = SCENE, **arguments) -> np.ndarray:
    return Renderer(**arguments).draw(World(scene), TASK)


def centroid(frame: np.ndarray, color) -> np.ndarray:
    """Mean row and column of the pixels of one colour."""
    return np.argwhere((frame == color).all(-1)).mean(0)


@pytest.mark.parametrize("name", TASKS)
def test_frame_format(name):
    task = get_task(name)
    frame = Renderer().draw(task.make_world(task.ranges.scene()), task)
    assert frame.shape == (64, 64, 3)
    assert frame.dtype == np.uint8


@pytest.mark.parametrize("name", TASKS)
def test_background_and_three_flat_colours_with_markers_in_green(name):
    task = get_task(name)
    scene = task.ranges.scene()
    frame = Renderer().draw(task.make_world(scene), task)
    assert tuple(frame[0, 0]) == scene.background_color
    colors = {tuple(map(int, c)) for c in frame.reshape(-1, 3)}
    assert colors == {scene.background_color, scene.cart_color, scene.block_color, (0, 200, 0)}


@pytest.mark.parametrize("name", ["balance_reaching_obstacle", "bin_dropping"])
def test_walls_are_drawn_where_they_stand(name):
    """Green is what lies in a wall of the world; a pixel's width is left open."""
    task, size = get_task(name), 192
    scene = task.sample_scene(np.random.default_rng(0)).replace(cart_x=0.12, cart_y=0.85, goal_x=0.8)
    world = task.make_world(scene)
    walls = [s for s in world.space.static_body.shapes if s.collision_type == WALL]
    green = (Renderer(size).draw(world, task) == GOAL_COLOR).all(-1)
    inside, outside = np.zeros_like(green), np.zeros_like(green)
    for row in range(size):
        for column in range(size):
            point = (column + 0.5) / size, 1 - (row + 0.5) / size
            distance = min(wall.point_query(point).distance for wall in walls)
            inside[row, column] = distance < -1 / size
            outside[row, column] = distance > 2 / size
    if name == "balance_reaching_obstacle":  # its goal is drawn as well
        rows, columns = np.indices(green.shape)
        goal = np.hypot(columns / size - scene.goal_x, 1 - rows / size - scene.goal_y) < 0.04
        outside &= ~goal
    assert inside.sum() > 20
    assert green[inside].all()
    assert not green[outside].any()


def color_at(point, task, scene: Scene) -> tuple:
    x, y = point
    return tuple(Renderer().draw(task.make_world(scene), task)[int((1 - y) * 64), int(x * 64)])


@pytest.mark.parametrize("name", TASKS)
def test_cart_and_block_are_drawn_before_the_markers(name):
    task = get_task(name)
    scene = task.ranges.scene(cart_x=0.2, cart_y=0.8, goal_x=0.7, goal_y=0.3)
    for polygon, _ in task.markers(scene):
        x, y = middle = np.mean(polygon, 0)
        assert color_at(middle, task, scene) == GOAL_COLOR
        assert color_at(middle, task, scene.replace(cart_x=x, cart_y=y)) == scene.cart_color
        assert color_at(middle, task, scene.replace(cart_x=x, cart_y=y - 0.1)) == scene.block_color


@pytest.mark.parametrize("size", [64, 256])
def test_objects_are_where_the_world_has_them(size):
    frame, world = draw(size=size), World(SCENE)
    places = {
        SCENE.cart_color: world.position[:2],
        SCENE.block_color: world.position[3:5],
        GOAL_COLOR: world.goal,
    }
    for color, (x, y) in places.items():
        expected = (1 - y) * size - 0.5, x * size - 0.5
        np.testing.assert_allclose(centroid(frame, color), expected, atol=1.0)


@pytest.mark.parametrize("name", ["cart_color", "block_color"])
def test_ten_pixels_of_motion_are_ten_pixels(name):
    color = getattr(SCENE, name)
    start = centroid(draw(), color)
    right = centroid(draw(SCENE.replace(cart_x=0.3 + 10 * PIXEL)), color)
    up = centroid(draw(SCENE.replace(cart_y=0.3 + 10 * PIXEL)), color)
    np.testing.assert_allclose(right - start, [0, 10], atol=1e-9)
    np.testing.assert_allclose(up - start, [-10, 0], atol=1e-9)


def test_box_is_turned_counterclockwise_about_its_centre():
    angle = np.pi / 6
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    level = np.array(box(0, 0, 0, 0.4, 0.2))
    np.testing.assert_allclose(level, [(-0.2, -0.1), (0.2, -0.1), (0.2, 0.1), (-0.2, 0.1)])
    np.testing.assert_allclose(box(0.5, 0.3, angle, 0.4, 0.2), level @ turn.T + [0.5, 0.3])


@pytest.mark.parametrize("name", TASKS)
def test_drawing_leaves_the_world_alone(name):
    task = get_task(name)
    watched, unwatched = (task.make_world(task.ranges.scene()) for _ in range(2))
    renderer = Renderer()
    for i in range(20):
        action = np.array([0.01 * np.sin(i), 0.005, 0.002])
        watched.step(action)
        unwatched.step(action)
        first = renderer.draw(watched, task)
        np.testing.assert_array_equal(first, renderer.draw(watched, task))
        np.testing.assert_array_equal(watched.position, unwatched.position)


def test_earlier_frames_stay_as_they_were():
    renderer, world = Renderer(), World(SCENE)
    first = renderer.draw(world, TASK)
    copy = first.copy()
    renderer.draw(World(SCENE.replace(cart_x=0.6)), TASK)
    np.testing.assert_array_equal(first, copy)


def test_supersampling_softens_edges_and_keeps_the_picture():
    hard, soft = draw(), draw(supersample=4)
    assert soft.shape == hard.shape
    assert len(np.unique(soft.reshape(-1, 3), axis=0)) > 4
    assert np.abs(soft.astype(float) - hard).mean() < 3


def test_no_display_is_opened():
    draw()
    assert not pygame.display.get_init()
