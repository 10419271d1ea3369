"""The tasks: what is drawn beside cart and block, what is rewarded, and what counts as success.

A task is any object with the attributes and methods of :class:`BalanceReaching`; to add one, write such a class
and put it into :data:`TASKS`.
"""

from __future__ import annotations

import math

import numpy as np

from .scene import GOAL_COLOR, Color, Scene, SceneRanges, sample_scene
from .world import ACCELERATION_LIMIT, EPISODE_STEPS, VELOCITY_LIMIT, World

SUCCESS_DISTANCE = 0.05  # m, about 3 pixels
MARKER_SIZE = 0.04  # m

Polygon = list[tuple[float, float]]


class BalanceReaching:
    """Task 1: the cart carries the block to the goal, a green square, and stays there.

    Reward, in [-0.2, 1] a step: ``0.4 exp(-4 d) + 0.6 exp(-25 d)`` for a goal distance d in m, less small
    penalties on the cart's acceleration and tilt; 0 once the block is dropped.

    Success: after 120 steps the block was never dropped and the mean goal distance of the last 10 steps is under
    50 mm (paper, Sec. V-B).
    """

    name = "balance_reaching"
    description = "Carry the free-standing block to the green goal without dropping it."
    state_size = 16

    def sample_scene(self, rng: np.random.Generator, ranges: SceneRanges) -> Scene:
        return sample_scene(rng, ranges)

    def make_world(self, scene: Scene) -> World:
        return World(scene)

    def goal(self, world: World) -> np.ndarray:
        """What the policy is conditioned on, ``[2]``: the goal's x and y (m)."""
        return world.goal

    def state(self, world: World) -> np.ndarray:
        """The privileged observation of the experts, ``[16]`` float32, scaled by known ranges to about [-1, 1]
        and clipped to [-10, 10].

        Goal relative to the cart (2), cart pose (3) and velocity (3), block pose (3) and velocity (3) relative to
        the cart, cart width, block height.
        """
        s = world.scene
        x, y, tilt = world.block_in_cart
        cart_x, cart_y, theta = world.position[:3].tolist()
        vx, vy, spin = (world.velocity[:3] / VELOCITY_LIMIT).tolist()
        relative = world.velocity[3:] - world.velocity[:3]
        standing = (s.cart_height + s.block_height) / 2
        state = np.array(
            [
                2 * (world.goal[0] - cart_x),
                2 * (world.goal[1] - cart_y),
                2 * (cart_x - 0.5),
                2 * (cart_y - 0.5),
                2 * theta,
                vx,
                vy,
                spin,
                10 * x,
                10 * (y - standing),
                2 * tilt,
                5 * relative[0],
                5 * relative[1],
                relative[2],
                20 * (s.cart_width - 0.25),
                20 * (s.block_height - 0.16),
            ],
            dtype=np.float32,
        )
        return state.clip(-10.0, 10.0)

    def reward(self, world: World) -> float:
        if world.dropped:
            return 0.0
        d = world.goal_distance
        effort = float(np.square(world.acceleration[:3] / ACCELERATION_LIMIT).sum())
        return (
            0.4 * math.exp(-4 * d)
            + 0.6 * math.exp(-25 * d)
            - 0.02 * effort
            - 0.1 * min(abs(world.position[2]), 1.0)
        )

    def is_success(self, world: World) -> bool:
        return world.steps >= EPISODE_STEPS and not world.dropped and world.position_error < SUCCESS_DISTANCE

    def markers(self, scene: Scene) -> list[tuple[Polygon, Color]]:
        """What is drawn behind cart and block: polygons in m, with their colours."""
        return [(square(scene.goal_x, scene.goal_y, MARKER_SIZE), GOAL_COLOR)]


def square(x: float, y: float, side: float) -> Polygon:
    half = side / 2
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


TASKS = {task.name: task for task in (BalanceReaching(),)}


def get_task(name: str) -> BalanceReaching:
    """The task of a name; ``ValueError`` lists the known ones."""
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from {sorted(TASKS)}")
    return TASKS[name]
