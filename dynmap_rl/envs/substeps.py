"""Substeps of a control step, during which the cart's velocity goes linearly from one value to another.

The loop calls Chipmunk's functions through PyMunk's own cffi library, without body objects in between. The results have
the same bits as those of ``space.step``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pymunk
from pymunk._chipmunk import lib

Bodies = tuple[pymunk.Space, pymunk.Body, pymunk.Body]  # a space, its cart and its block


def run_substeps(
    worlds: Sequence[Bodies], before: np.ndarray, after: np.ndarray, steps: int, dt: float
) -> np.ndarray:
    """Step every space while its cart moves, in each substep, at the velocity of the substep's middle.

    Shapes and bodies that a collision callback adds or removes are added or removed after the last substep.

    Args:
        worlds: space, cart and block of each world.
        before: velocity of each cart at the start, float64 ``[N, 3]`` (m/s, m/s, rad/s).
        after: velocity of each cart at the end, float64 ``[N, 3]``.
        steps: number of substeps, at least 1.
        dt: duration of a substep (s).

    Returns:
        :func:`read_bodies` of each world, ``[N, 12]``.
    """
    middles = (np.arange(steps) + 0.5) / steps
    velocities = before[:, None] + (after - before)[:, None] * middles[:, None]  # [N, steps, 3]
    for (space, cart, _), rows, end in zip(worlds, velocities.tolist(), after.tolist(), strict=True):
        *first, last = rows
        _step(space, cart, first, dt)
        _steer(cart, last)
        space.step(dt)  # also adds and removes what callbacks asked for
        _steer(cart, end)
    return np.array([read_bodies(cart, block) for _, cart, block in worlds])


def _step(space: pymunk.Space, cart: pymunk.Body, velocities: list[list[float]], dt: float) -> None:
    step, set_velocity, set_angular = lib.cpSpaceStep, lib.cpBodySetVelocity, lib.cpBodySetAngularVelocity
    c_space, c_cart = space._space, cart._body
    space._locked = True  # so that PyMunk defers what callbacks add or remove
    try:
        for x, y, angular in velocities:
            set_velocity(c_cart, (x, y))
            set_angular(c_cart, angular)
            step(c_space, dt)
    finally:
        space._locked = False


def _steer(cart: pymunk.Body, velocity: list[float]) -> None:
    x, y, cart.angular_velocity = velocity
    cart.velocity = (x, y)


def read_bodies(*bodies: pymunk.Body) -> list[float]:
    """Return positions x, y, angle of each body (m, m, rad), then their velocities."""
    positions = [value for body in bodies for value in (*body.position, body.angle)]
    return positions + [value for body in bodies for value in (*body.velocity, body.angular_velocity)]
