"""Simulation of a position-controlled cart that carries a free-standing block (paper, Sec. IV).

Plain Python and PyMunk. SI units: m, s, rad, kg. Gravity points along -y.
"""

from __future__ import annotations

import atexit
import math
import weakref
from collections.abc import Sequence

import numpy as np
import pymunk

from .scene import Point, Scene
from .substeps import read_bodies, run_substeps

GRAVITY = 9.81  # m/s^2
CONTROL_DT = 0.05  # s, 20 Hz
SUBSTEPS = 50  # of 1 ms each
EPISODE_STEPS = 120
FINAL_STEPS = 10  # over which the position error is a mean

# Limits of the cart per axis (x, y, theta), the same for experts and policies.
VELOCITY_LIMIT = np.array([0.8, 0.8, 2.0])  # m/s, m/s, rad/s
ACCELERATION_LIMIT = np.array([6.0, 6.0, 20.0])  # m/s^2, m/s^2, rad/s^2
WORKSPACE_LOW = np.array([0.05, 0.03, -math.pi / 3])  # m, m, rad
WORKSPACE_HIGH = np.array([0.95, 0.95, math.pi / 3])
ACTION_LIMIT = VELOCITY_LIMIT * CONTROL_DT  # the largest change of the commanded pose in one control step
LARGEST_CHANGE = ACCELERATION_LIMIT * CONTROL_DT**2  # between the actions of two consecutive control steps

GROUND = -0.25  # m, height at which a dropped block comes to rest, below the picture
DROP_TILT = math.pi / 4  # rad, relative to the cart
WALL_RADIUS = 0.01  # m, half the thickness of a wall

SPACES: weakref.WeakSet[pymunk.Space] = weakref.WeakSet()  # all that exist
Wall = tuple[Point, Point]  # the ends of its middle line, m
CART, BLOCK, WALL = 1, 2, 3  # PyMunk collision types


@atexit.register
def _free_spaces() -> None:
    """Free what is left at the end of the program; later, PyMunk would lack what it needs for it."""
    for space in SPACES:
        vars(space).clear()


class World:
    """Cart and block of one scene, and fixed walls.

    Walls stop the block. The cart follows its command in any case and passes through them. Both contacts are recorded
    in ``touched``.

    Args:
        scene: sizes and start.
        walls: the two ends of each wall (m); walls are 20 mm thick and rounded.

    Attributes:
        position, velocity, acceleration: cart x, y, theta, block x, y, theta, each float64 ``[6]`` (SI units). The
            acceleration is ``(velocity_t - velocity_{t-1}) / CONTROL_DT``, zero at the start.
        block_in_cart: pose of the block in the cart's frame: x, y (m) from the cart's centre, and angle (rad).
        commanded: commanded cart pose ``[3]``, the start pose plus the sum of all actions.
        action: last action ``[3]`` as it was executed, within the limits.
        goal: goal of the cart's centre ``[2]`` (m).
        steps: number of control steps so far.
        dropped: whether the block was ever not carried: it leaned over by more than 45 degrees relative to the cart,
            its centre was below half its standing height over the cart's top, or it was beyond the cart's edge.
        touched: which of ``"cart"`` and ``"block"`` ever touched a wall.
        errors: distances of cart and goal (m), at the start and after each control step.
    """

    def __init__(self, scene: Scene, walls: Sequence[Wall] = ()):
        self.scene = scene
        self.goal = np.array([scene.goal_x, scene.goal_y])
        self.space = pymunk.Space()
        SPACES.add(self.space)
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
        self.space.on_collision(CART, WALL, begin=_touch, data={"touched": self.touched, "name": "cart"})
        self.space.on_collision(BLOCK, WALL, begin=_touch, data={"touched": self.touched, "name": "block"})

    def step(self, action: np.ndarray) -> None:
        """Simulate one control step of 50 ms with the position-update action ``(dX, dY, dTheta)`` (m, m, rad).

        The change of the commanded pose becomes a constant acceleration by the second difference of commanded
        positions, ``(a_t - a_{t-1}) / CONTROL_DT**2``, within the limits (paper, Sec. IV-A).

        Raises:
            ValueError: the action is not 3 finite numbers.
        """
        step_worlds([self], [action])

    def _finish(self, action: np.ndarray, bodies: np.ndarray) -> None:
        """Record an executed action, and positions and velocities ``[12]`` of the bodies after it."""
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
        """Simulate one control step at a constant acceleration of the cart (m/s^2, m/s^2, rad/s^2)."""
        self.step(self.action_for(acceleration))

    def action_for(self, acceleration: np.ndarray) -> np.ndarray:
        """Return the position-update action that gives this acceleration of the cart in the next step."""
        acceleration = np.asarray(acceleration, dtype=np.float64)
        if acceleration.shape != (3,):
            raise ValueError(f"an acceleration must be 3 finite numbers, got {acceleration}")
        return self.action + acceleration * CONTROL_DT**2

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


def _touch(arbiter, space, data: dict) -> None:
    """Record a contact; a function of the module, so that copies of a world have records of their own."""
    data["touched"].add(data["name"])


def step_worlds(worlds: Sequence[World], actions: Sequence[np.ndarray]) -> None:
    """Simulate one control step of each world (see :meth:`World.step`).

    This is faster than one world after the other and gives the same bits.

    Args:
        worlds: N worlds.
        actions: one action (m, m, rad) for each world.

    Raises:
        ValueError: an action is not 3 finite numbers.
    """
    last = np.array([world.action for world in worlds])
    limited = limit_actions(worlds, actions)
    found = simulate(worlds, last / CONTROL_DT, limited / CONTROL_DT)
    for world, action, bodies in zip(worlds, limited, found, strict=True):
        world._finish(action, bodies)


def simulate(worlds: Sequence[World], before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Simulate 50 substeps of 1 ms, in which the carts' velocities go linearly from ``before`` to ``after``.

    Args:
        worlds: N worlds.
        before: velocities of the carts at the start, ``[N, 3]`` (m/s, m/s, rad/s).
        after: velocities of the carts at the end, ``[N, 3]``.

    Returns:
        Positions and velocities of the bodies after the control step, ``[N, 12]`` (SI units).
    """
    bodies = [(world.space, world.cart, world.block) for world in worlds]
    return run_substeps(bodies, before, after, SUBSTEPS, CONTROL_DT / SUBSTEPS)


# For the largest speed from which a cart can brake at the limit, in whole control steps, before the workspace ends.
WAYS, EDGES = np.array([[[1.0]], [[-1.0]]]), np.stack([-WORKSPACE_LOW, WORKSPACE_HIGH])[:, None]
HALF_BRAKE, TWICE = ACCELERATION_LIMIT * CONTROL_DT / 2, 2 * ACCELERATION_LIMIT
HALF_SQUARED = HALF_BRAKE**2


def limit_actions(worlds: Sequence[World], actions: Sequence[np.ndarray]) -> np.ndarray:
    """Return the actions that the carts can execute, within limits of acceleration, speed and workspace.

    Args:
        worlds: N worlds.
        actions: one action (m, m, rad) for each world.

    Returns:
        ``[N, 3]``, rounded to float32 as they are stored, so that a replay is bit-exact.

    Raises:
        ValueError: an action is not 3 finite numbers.
    """
    last = np.array([world.action for world in worlds])
    commanded = np.array([world.commanded for world in worlds])
    wanted = np.array(actions, dtype=np.float64)
    if wanted.shape != last.shape or not np.isfinite(wanted).all():
        raise ValueError(
            f"an action must be 3 finite numbers (dX, dY, dTheta) for each of {len(last)} worlds, got {wanted}"
        )
    room = np.maximum(WAYS * commanded + EDGES, 0.0)  # [2, N, 3]
    speed = np.sqrt(HALF_SQUARED + TWICE * room) - HALF_BRAKE
    back, forth = np.minimum(speed, VELOCITY_LIMIT) * CONTROL_DT
    wanted = np.minimum(np.maximum(wanted, -back), forth)
    limited = np.minimum(np.maximum(wanted, last - LARGEST_CHANGE), last + LARGEST_CHANGE)
    return limited.astype(np.float32).astype(np.float64)
