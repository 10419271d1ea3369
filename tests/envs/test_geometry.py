"""The obstacle in the way: who touches it, and the shortest way around it, against PyMunk and a search on a grid."""

import math
from itertools import pairwise

import numpy as np
import pymunk
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from dynmap_rl.envs.geometry import hits, is_clear, length, path_is_blocked, way_around
from dynmap_rl.envs.scene import ObstacleRanges, ObstacleScene
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import CONTROL_DT, WALL, WALL_RADIUS

TASK = get_task("balance_reaching_obstacle")
ANYWHERE = ObstacleRanges(
    obstacle_x=(0.3, 0.7), obstacle_y=(0.3, 0.7), obstacle_length=(0.1, 0.3), min_distance=0.0
)
MARGIN = 0.03


def random_scenes(count: int) -> list[ObstacleScene]:
    """Start, goal and obstacle anywhere, also within each other."""
    return [ANYWHERE.scene(**draw(seed)) for seed in range(count)]


def draw(seed: int) -> dict:
    rng = np.random.default_rng(seed)
    names = ("cart_width", "block_height", "block_shift", "cart_x", "cart_y", "goal_x", "goal_y")
    names += ("obstacle_x", "obstacle_y", "obstacle_length")
    return {name: float(rng.uniform(*getattr(ANYWHERE, name))) for name in names}


def forbidden(scene: ObstacleScene, x, y, margin: float = MARGIN):
    """Whether a box around the largest cart and block, as wide as the cart, is within ``margin`` of the obstacle, or
    under one that leaves no room for it above the lowest place a cart can be at."""
    width, tall = max(scene.cart_width, 0.3), max(scene.block_height, 0.2)
    left, right = x - width / 2, x + width / 2
    bottom, top = y - 0.02, y + 0.02 + tall
    beside = (right + margin <= scene.obstacle_x - 0.01) | (left - margin >= scene.obstacle_x + 0.01)
    half = scene.obstacle_length / 2
    room = scene.obstacle_y - half - MARGIN - 0.02 - tall > 0.03
    over = (bottom - margin >= scene.obstacle_y + half) | (room & (top + margin <= scene.obstacle_y - half))
    return np.logical_not(beside | over)


def along(start, end, count: int = 200) -> np.ndarray:
    """Points of a straight line, ``[2, count]``, without its ends."""
    return np.linspace(start, end, count + 2)[1:-1].T


# Who touches the obstacle


def overlaps(scene: ObstacleScene, margin: float = 0.0) -> bool:
    """PyMunk's own answer for the cart and block of a world, with a wall that is thicker by a margin."""
    world = TASK.make_world(scene)
    [wall] = [s for s in world.space.static_body.shapes if s.collision_type == WALL]
    wall = pymunk.Segment(world.space.static_body, wall.a, wall.b, WALL_RADIUS + margin)
    shapes = [*world.cart.shapes, *world.block.shapes]
    return any(info.shape in shapes for info in world.space.shape_query(wall))


def test_hits_is_contact_in_the_world():
    """But for the wall's rounded corners: its rectangle reaches up to 4.2 mm further."""
    answers = [
        (overlaps(s), hits(s, s.cart_x, s.cart_y), overlaps(s, margin=0.0042)) for s in random_scenes(300)
    ]
    contact, hit, nearly = np.array(answers).T
    assert 45 < contact.sum() < 255
    assert not (contact & ~hit).any()
    assert not (hit & ~nearly).any()


def test_hits_begin_where_the_edges_meet():
    scene = ObstacleScene(
        cart_width=0.24, cart_height=0.04, block_height=0.16, obstacle_y=0.5, obstacle_length=0.2
    )
    places = {  # of the cart, which would just touch
        "left": (0.5 - 0.01 - 0.12, 0.5, (-1, 0)),
        "right": (0.5 + 0.01 + 0.12, 0.5, (1, 0)),
        "above": (0.5, 0.6 + 0.02, (0, 1)),
        "below": (0.5, 0.4 - 0.16 - 0.02, (0, -1)),
    }
    for name, (x, y, (dx, dy)) in places.items():
        assert hits(scene, x - 0.001 * dx, y - 0.001 * dy), name
        assert not hits(scene, x + 0.001 * dx, y + 0.001 * dy), name


def test_scenes_of_task_2_are_clear_of_the_obstacle_at_start_and_goal():
    for seed in range(60):
        scene = TASK.sample_scene(np.random.default_rng(seed))
        at_goal = scene.replace(cart_x=scene.goal_x, cart_y=scene.goal_y)
        assert not overlaps(scene, MARGIN - 1e-4)
        assert not overlaps(at_goal, MARGIN - 1e-4)
        world = TASK.make_world(scene)
        world.step(np.zeros(3))
        assert world.touched == set()


def touches_on_the_line(scene: ObstacleScene, seconds: float = 5.0) -> bool:
    """Drive the cart smoothly along the straight line from start to goal."""
    world = TASK.make_world(scene)
    steps = round(seconds / CONTROL_DT)
    done = (1 - np.cos(np.linspace(0, np.pi, steps + 1))) / 2
    line = np.array([scene.goal_x - scene.cart_x, scene.goal_y - scene.cart_y, 0])
    for share in np.diff(done):
        world.step(share * line)
        if world.touched:
            return True
    assert world.goal_distance < 2e-3 and not world.dropped
    return False


def test_blocked_is_where_a_straight_drive_touches_the_obstacle():
    blocked, touched = [], []
    for seed in range(20):
        scene = TASK.sample_scene(np.random.default_rng(seed))
        wider = scene.replace(
            obstacle_length=scene.obstacle_length + 0.01, cart_width=scene.cart_width + 0.01
        )
        narrower = scene.replace(
            obstacle_length=scene.obstacle_length - 0.01, cart_width=scene.cart_width - 0.01
        )
        if path_is_blocked(wider) == path_is_blocked(narrower):  # no grazing
            blocked.append(path_is_blocked(scene))
            touched.append(touches_on_the_line(scene))
    assert blocked == touched
    assert len(blocked) > 15 and 4 < sum(blocked) < len(blocked) - 4


# The way around it


def grid_lengths(scene: ObstacleScene, start, goals, cell: float = 0.01) -> np.ndarray:
    """Lengths of the shortest ways over a grid of 10 mm, in 32 directions; all points lie on the grid."""
    side = np.arange(-20, 121)
    columns, rows = np.meshgrid(side, side, indexing="ij")
    index = np.arange(columns.size).reshape(columns.shape)
    begins, ends, weights = [], [], []
    for dx in range(-3, 4):
        for dy in range(-3, 4):
            if math.gcd(dx, dy) != 1:
                continue
            begin = (columns + dx >= -20) & (columns + dx <= 120) & (rows + dy >= -20) & (rows + dy <= 120)
            for share in np.linspace(0, 1, 9):
                begin &= ~forbidden(scene, (columns + share * dx) * cell, (rows + share * dy) * cell)
            i, k = begin.nonzero()
            begins.append(index[i, k])
            ends.append(index[i + dx, k + dy])
            weights.append(np.full(len(i), cell * math.hypot(dx, dy)))
    edges = np.concatenate(weights), (np.concatenate(begins), np.concatenate(ends))
    nodes = [index[round(x / cell) + 20, round(y / cell) + 20] for x, y in (start, *goals)]
    return dijkstra(coo_array(edges, (index.size,) * 2).tocsr(), indices=nodes[0])[nodes[1:]]


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
def test_way_is_the_shortest(seed):
    rng = np.random.default_rng(seed)
    scene = random_scenes(4)[seed]
    points = [tuple(p) for p in rng.integers(0, 101, (60, 2)) / 100]
    start, *goals = [p for p in points if not forbidden(scene, *p, margin=MARGIN + 0.001)]
    ours = np.array([length(way_around(scene, start, goal)) for goal in goals])
    grid = grid_lengths(scene, start, goals)
    detours = ours > [1.01 * math.dist(start, goal) for goal in goals]
    assert len(goals) > 25 and detours.sum() >= 5
    assert (ours <= grid + 2e-3).all()
    assert (grid <= 1.015 * ours + 0.025).all()


def test_way_never_enters_and_is_straight_where_it_can_be():
    around = 0
    for scene in random_scenes(200):
        start, goal = (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y)
        if forbidden(scene, *start) or forbidden(scene, *goal):
            continue
        way = way_around(scene, start, goal)
        assert (way[0], way[-1]) == (start, goal)
        for leg in pairwise(way):
            assert not forbidden(scene, *along(*leg), margin=MARGIN - 1e-6).any()
        if forbidden(scene, *along(start, goal, 1000)).any():
            around += 1
            assert len(way) > 2
            assert length(way) > math.dist(start, goal)
        else:
            assert way == [start, goal]
    assert around > 10


def test_way_from_within_leads_straight_out_first():
    seen = 0
    for scene in random_scenes(200):
        start, goal = (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y)
        if not forbidden(scene, *start) or forbidden(scene, *goal):
            continue
        seen += 1
        way = way_around(scene, start, goal)
        assert (way[0], way[-1]) == (start, goal)
        out = np.subtract(way[1], start)
        assert np.count_nonzero(out) == 1
        step = np.abs(out).max() - 1e-3
        nearer = [forbidden(scene, *(start + step * np.array(d))) for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        assert all(nearer), "another side is nearer"
        for leg in pairwise(way[1:]):
            assert not forbidden(scene, *along(*leg), margin=MARGIN - 1e-6).any()
    assert seen > 15


def test_way_is_as_long_back_as_forth_and_no_shorter_than_the_straight_line():
    for scene in random_scenes(200):
        start, goal = (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y)
        forth = length(way_around(scene, start, goal))
        assert forth == pytest.approx(length(way_around(scene, goal, start)))
        assert forth >= math.dist(start, goal) - 1e-12
        assert way_around(scene, start, start)[0] == start


@pytest.mark.parametrize(
    ("end", "clear"),
    [
        ((3.0, 0.0), True),  # along the edge
        ((1.0, 3.0), True),  # beside it
        ((3.0, 0.001), False),
        ((2.0, 2.0), True),  # past its corner
        ((2.0, 1.9), False),
        ((0.5, 0.5), True),  # ends before it
        ((0.0, 0.0), True),
    ],
)
def test_line_is_clear_of_a_square(end, clear):
    assert is_clear((0.0, 0.0), end, (1.0, 0.0), (2.0, 1.0)) is clear
