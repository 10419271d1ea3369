"""The simulated world: a position-controlled cart that carries a free-standing block (paper, Sec. IV).

Plain Python and PyMunk. SI units: m, s, rad, kg. Gravity points along -y.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pymunk

from .scene import Point, Scene
from .substeps import choose_run, read_bodies

GRAVITY = 9.81  # m/s^2
CONTROL_DT = 0.05  # s, 20 Hz
SUBSTEPS = 50  # of 1 ms each
EPISODE_STEPS = 120
FINAL_STEPS = 10  # the position error is a mean over the last 10 steps

# The limits of the cart, for experts and students alike, per axis (x, y, theta).
VELOCITY_LIMIT = np.array([0.4, 0.4, 1.0])  # m/s, m/s, rad/s
ACCELERATION_LIMIT = np.array([3.0, 3.0, 10.0])  # m/s^2, m/s^2, rad/s^2
WORKSPACE_LOW = np.array([0.05, 0.03, -math.pi / 3])  # m, m, rad
WORKSPACE_HIGH = np.array([0.95, 0.95, math.pi / 3])
ACTION_LIMIT = VELOCITY_LIMIT * CONTROL_DT  # the largest change of the commanded pose in one control step
LARGEST_CHANGE = ACCELERATION_LIMIT * CONTROL_DT**2  # of an action, from one control step to the next

GROUND = -0.25  # m, where a dropped block comes to lie, below the picture
DROP_TILT = math.pi / 4  # rad, relative to the cart
WALL_RADIUS = 0.01  # m, half the thickness of a wall

Wall = tuple[Point, Point]  # the ends of its middle line, m
CART, BLOCK, WALL = 1, 2, 3  # PyMunk collision types


class World:
    """Cart and block of one scene, and walls that do not move.

    The block collides with walls; the cart, which follows its command whatever comes, goes through them. Both are
    noticed.

    Args:
        scene: sizes and start.
        walls: the ends of each, 20 mm thick and rounded.

    Arrays hold cart x, y, theta, block x, y, theta, in this order, ``[6]`` float64:

    Attributes:
        position, velocity: read from PyMunk.
        acceleration: ``(velocity_t - velocity_{t-1}) / CONTROL_DT``, zero at the start.
        block_in_cart: the block's pose in the cart's frame: x, y (m) from the cart's centre, and angle (rad).
        commanded: ``[3]`` commanded cart pose, the start pose plus the sum of all actions.
        action: ``[3]`` the last action as executed, after the limits.
        goal: ``[2]`` where the cart shall go.
        steps: control steps so far.
        dropped: the block is, or once was, no longer carried: it leaned over by more than 45 degrees relative
            to the cart, its centre sank below half its standing height over the cart's top, or it moved beyond
            the cart's edge.
        touched: which of ``"cart"`` and ``"block"`` touches, or once touched, a wall.
        errors: distance of cart and goal after every control step, the start first (m).
    """

    def __init__(self, scene: Scene, walls: Sequence[Wall] = ()):
        self.scene = scene
        self.goal = np.array([scene.goal_x, scene.goal_y])
        self.space = pymunk.Space()
        self.space.gravity = (0.0, -GRAVITY)
        self.space.collision_slop = 1e-4  # Chipmunk's default assumes pixels
        self._add_ground()
        self._add_cart(scene)
        self._add_block(scene)
        self._add_walls(walls)
        self.commanded = np.array([scene.cart_x, scene.cart_y, 0.0])
        self.action = np.zeros(3)
        self.position = np.array(read_bodies(self.cart, self.block)[:6])
        self.block_in_cart = self._locate_block()
        self.velocity = np.zeros(6)
        self.acceleration = np.zeros(6)
        self.steps = 0
        self.dropped = False
        self.errors = [self.goal_distance]

    def _add_ground(self) -> None:
        thickness = 0.5
        ends = (-100.0, GROUND - thickness), (100.0, GROUND - thickness)
        shape = pymunk.Segment(self.space.static_body, *ends, radius=thickness)
        shape.friction = 1.0
        self.space.add(shape)

    def _add_cart(self, s: Scene) -> None:
        self.cart = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.cart.position = (s.cart_x, s.cart_y)
        shape = pymunk.Poly.create_box(self.cart, (s.cart_width, s.cart_height))
        shape.friction = 1.0  # Chipmunk multiplies the two frictions
        shape.collision_type = CART
        self.space.add(self.cart, shape)

    def _add_block(self, s: Scene) -> None:
        size = (s.block_width, s.block_height)
        mass = s.density * s.block_width * s.block_height
        self.block = pymunk.Body(mass, pymunk.moment_for_box(mass, size))
        self.block.position = (s.cart_x + s.block_shift, s.cart_y + (s.cart_height + s.block_height) / 2)
        shape = pymunk.Poly.create_box(self.block, size)
        shape.friction = s.friction
        shape.collision_type = BLOCK
        self.space.add(self.block, shape)

    def _add_walls(self, walls: Sequence[Wall]) -> None:
        self.touched: set[str] = set()
        if not walls:
            return
        for start, end in walls:
            shape = pymunk.Segment(self.space.static_body, start, end, WALL_RADIUS)
            shape.friction = 1.0
            shape.collision_type = WALL
            self.space.add(shape)
        touched = self.touched
        self.space.on_collision(CART, WALL, begin=lambda *_: touched.add("cart"))
        self.space.on_collision(BLOCK, WALL, begin=lambda *_: touched.add("block"))

    def step(self, action: np.ndarray) -> None:
        """One control step of 50 ms with the position-update action ``(dX, dY, dTheta)`` (m, m, rad).

        The change of the commanded pose becomes a constant acceleration by the second difference of commanded
        positions, ``(a_t - a_{t-1}) / CONTROL_DT**2``, within the limits (paper, Sec. IV-A).
        """
        step_worlds([self], [action])

    def _finish(self, action: np.ndarray, bodies: np.ndarray) -> None:
        """Note where the simulation of an action has led: positions and velocities, ``[12]``."""
        velocity = bodies[6:]
        self.action = action
        self.commanded = self.commanded + action
        self.acceleration = (velocity - self.velocity) / CONTROL_DT
        self.velocity = velocity
        self.position = bodies[:6]
        self.block_in_cart = self._locate_block()
        self.steps += 1
        self.dropped = self.dropped or self._is_dropped()
        self.errors.append(self.goal_distance)

    def accelerate(self, acceleration: np.ndarray) -> None:
        """One control step at a constant cart acceleration (m/s^2, m/s^2, rad/s^2), the expert's interface."""
        self.step(self.action_for(acceleration))

    def action_for(self, acceleration: np.ndarray) -> np.ndarray:
        """The position-update action that gives this cart acceleration from the present state."""
        return self.action + np.asarray(acceleration, dtype=np.float64) * CONTROL_DT**2

    def _locate_block(self) -> tuple[float, float, float]:
        cx, cy, ct, bx, by, bt = self.position.tolist()
        c, s = math.cos(ct), math.sin(ct)
        dx, dy = bx - cx, by - cy
        return c * dx + s * dy, c * dy - s * dx, bt - ct

    def _is_dropped(self) -> bool:
        x, y, tilt = self.block_in_cart
        s = self.scene
        standing = s.cart_height / 2 + s.block_height / 4
        return abs(tilt) > DROP_TILT or y < standing or abs(x) > s.cart_width / 2

    @property
    def goal_distance(self) -> float:
        """Distance of the cart's centre and the goal (m)."""
        return math.dist(self.position[:2].tolist(), self.goal.tolist())

    @property
    def position_error(self) -> float:
        """Mean distance of cart and goal over the last 10 steps (m), PE in the paper."""
        last = self.errors[max(1, len(self.errors) - FINAL_STEPS) :] or self.errors
        return sum(last) / len(last)


def step_worlds(worlds: Sequence[World], actions: Sequence[np.ndarray], threads: int = 1) -> None:
    """:meth:`World.step` of every world at once, which is faster than one after the other and gives the same bits, with
    any number of threads."""
    last = np.array([world.action for world in worlds])
    limited = _limit(actions, last, np.array([world.commanded for world in worlds]))
    limited = limited.astype(np.float32).astype(np.float64)  # as stored, so that a replay is bit-exact
    found = simulate(worlds, last / CONTROL_DT, limited / CONTROL_DT, threads)
    for world, action, bodies in zip(worlds, limited, found, strict=True):
        world._finish(action, bodies)


def simulate(worlds: Sequence[World], before: np.ndarray, after: np.ndarray, threads: int = 1) -> np.ndarray:
    """50 steps of 1 ms while the carts' velocities ``[N, 3]`` go linearly from ``before`` to ``after``; positions and
    velocities of the bodies, ``[N, 12]``."""
    # The velocity in the middle of each substep: the cart's path is then the exact parabola.
    bodies = [(world.space, world.cart, world.block) for world in worlds]
    return choose_run()(bodies, before, after, SUBSTEPS, CONTROL_DT / SUBSTEPS, threads)


# Of the speed from which a cart stops within its room back and forth, braking at the limit in whole control steps.
WAYS, EDGES = np.array([[[1.0]], [[-1.0]]]), np.stack([-WORKSPACE_LOW, WORKSPACE_HIGH])[:, None]
HALF_BRAKE, TWICE = ACCELERATION_LIMIT * CONTROL_DT / 2, 2 * ACCELERATION_LIMIT
HALF_SQUARED = HALF_BRAKE**2


def _limit(actions: Sequence[np.ndarray], last: np.ndarray, commanded: np.ndarray) -> np.ndarray:
    """The actions ``[N, 3]`` that the carts can execute: limits of acceleration, of speed, and room left to brake."""
    wanted = np.array(actions, dtype=np.float64)
    if wanted.shape != last.shape or not np.isfinite(wanted).all():
        raise ValueError(f"an action is 3 finite numbers (dX, dY, dTheta), got {wanted}")
    room = np.maximum(WAYS * commanded + EDGES, 0.0)  # [2, N, 3]
    speed = np.sqrt(HALF_SQUARED + TWICE * room) - HALF_BRAKE
    back, forth = np.minimum(speed, VELOCITY_LIMIT) * CONTROL_DT
    wanted = np.minimum(np.maximum(wanted, -back), forth)
    return np.minimum(np.maximum(wanted, last - LARGEST_CHANGE), last + LARGEST_CHANGE)
