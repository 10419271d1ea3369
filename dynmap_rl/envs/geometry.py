"""Shapes of the tasks in the plane: goal marker, obstacle, bin, and the way around an obstacle. Lengths in m."""

from __future__ import annotations

import math

import numpy as np

from .scene import BinScene, ObstacleScene, Point, SceneRanges
from .world import WALL_RADIUS, WORKSPACE_LOW, Wall

Polygon = list[Point]

SIZES = SceneRanges()
MARGIN = 0.03  # m, between the obstacle and the largest cart and block


def square(x: float, y: float, side: float) -> Polygon:
    """Return the corners of an upright square around a point."""
    half = side / 2
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


def wall_polygon(start: Point, end: Point) -> Polygon:
    """Return the corners of the rectangle around a vertical or horizontal wall."""
    (x0, x1), (y0, y1) = sorted((start[0], end[0])), sorted((start[1], end[1]))
    r = WALL_RADIUS
    return [(x0 - r, y0 - r), (x1 + r, y0 - r), (x1 + r, y1 + r), (x0 - r, y1 + r)]


def segment(scene: ObstacleScene) -> Wall:
    """Return the ends of the obstacle's middle line."""
    x, y, half = scene.obstacle_x, scene.obstacle_y, scene.obstacle_length / 2 - WALL_RADIUS
    return (x, y - half), (x, y + half)


def bin_walls(scene: BinScene) -> list[Wall]:
    """Return left wall, floor and right wall, outside the bin's inner width and depth."""
    left, right = (scene.goal_x + side * (scene.bin_width / 2 + WALL_RADIUS) for side in (-1, 1))
    top, floor = scene.goal_y - WALL_RADIUS, scene.goal_y - scene.bin_depth - WALL_RADIUS
    return [((left, top), (left, floor)), ((left, floor), (right, floor)), ((right, floor), (right, top))]


def path_is_blocked(scene: ObstacleScene) -> bool:
    """Return whether cart or block would touch the obstacle on the straight line from start to goal."""
    way = np.linspace((scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y), 200)
    return any(hits(scene, x, y) for x, y in way)


def hits(scene: ObstacleScene, x: float, y: float) -> bool:
    """Return whether the level cart at (x, y), or the block upright on it, overlaps the obstacle."""
    half = scene.obstacle_length / 2
    across = scene.obstacle_x - x

    def overlaps(middle, width, low, high):
        beside = abs(across - middle) < width / 2 + WALL_RADIUS
        return beside and scene.obstacle_y - half < high and low < scene.obstacle_y + half

    top = y + scene.cart_height / 2
    cart = overlaps(0.0, scene.cart_width, y - scene.cart_height / 2, top)
    return cart or overlaps(scene.block_shift, scene.block_width, top, top + scene.block_height)


def keep_out(scene: ObstacleScene) -> tuple[Point, Point]:
    """Return the rectangle that the cart's centre must avoid, as its lower left and upper right corner.

    Outside of it, the rectangle around the largest cart and block of the default ranges stays 30 mm away from the
    obstacle. It is the same for all sizes of cart and block, so that the way around it depends on positions alone.
    """
    x, y = scene.obstacle_x, scene.obstacle_y
    half_width = max(scene.cart_width, *SIZES.cart_width) / 2 + WALL_RADIUS + MARGIN
    half_height = scene.obstacle_length / 2 + max(scene.cart_height, *SIZES.cart_height) / 2 + MARGIN
    low = y - half_height - max(scene.block_height, *SIZES.block_height)
    low = low if low > WORKSPACE_LOW[1] else -1.0  # too little room under the obstacle
    return (x - half_width, low), (x + half_width, y + half_height)


def is_inside(point: Point, low: Point, high: Point) -> bool:
    """Return whether the point lies inside the rectangle; its edge is outside."""
    return low[0] < point[0] < high[0] and low[1] < point[1] < high[1]


def way_around(scene: ObstacleScene, start: Point, goal: Point) -> list[Point]:
    """Return the points of the shortest way of the cart's centre around :func:`keep_out`, from start to goal.

    From a point inside the rectangle the way first leads straight out.
    """
    low, high = keep_out(scene)
    outside = [leave(start, low, high), leave(goal, low, high)]
    if is_clear(*outside, low, high):
        ways = [outside]
    else:
        corners = [low, (high[0], low[1]), high, (low[0], high[1])]
        ways = [
            [outside[0], *dict.fromkeys((corners[i], corners[k % 4])), outside[1]]
            for i in range(4)
            if is_clear(outside[0], corners[i], low, high)
            for k in (i, i - 1, i + 1)
            if is_clear(corners[k % 4], outside[1], low, high)
        ]
    return list(dict.fromkeys((start, *min(ways, key=length), goal)))


def way_from_start(scene: ObstacleScene) -> list[Point]:
    """Return the points of the shortest way from the start of the scene to its goal (see :func:`way_around`)."""
    return way_around(scene, (scene.cart_x, scene.cart_y), (scene.goal_x, scene.goal_y))


def length(way: list[Point]) -> float:
    """Return the length of a way through points."""
    return sum(map(math.dist, way, way[1:]))


def leave(point: Point, low: Point, high: Point) -> Point:
    """Return the point itself, or the nearest one on the rectangle's edge if it lies inside."""
    if not is_inside(point, low, high):
        return point
    (x, y), (x0, y0), (x1, y1) = point, low, high
    edges = (x - x0, (x0, y)), (x1 - x, (x1, y)), (y - y0, (x, y0)), (y1 - y, (x, y1))
    return min(edges)[1]


def is_clear(start: Point, end: Point, low: Point, high: Point) -> bool:
    """Return whether a straight line avoids the inside of a rectangle; it may run along its edge."""
    enter, exit = 0.0, 1.0
    for a, b, lower, upper in zip(start, end, low, high, strict=True):
        if a == b:
            if not lower < a < upper:
                return True
        else:
            times = sorted(((lower - a) / (b - a), (upper - a) / (b - a)))
            enter, exit = max(enter, times[0]), min(exit, times[1])
    return enter >= exit - 1e-9
