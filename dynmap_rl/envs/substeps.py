"""Substeps of a control step, during which the cart's velocity goes linearly from one value to another.

The loop calls Chipmunk's functions through PyMunk's own cffi library, without body objects in between. The results have
the same bits as those of ``space.step``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pymunk
from pymunk._chipmunk import ffi, lib

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
        steps: number of substeps.
        dt: duration of a substep (s).

    Returns:
        :func:`read_bodies` of each world, ``[N, 12]``.
    """
    middles = (np.arange(steps) + 0.5) / steps
    velocities = before[:, None] + (after - before)[:, None] * middles[:, None]  # [N, steps, 3]
    linear, angular = np.ascontiguousarray(velocities[..., :2]), velocities[..., 2].tolist()
    for (space, cart, _), *speeds, end in zip(worlds, linear, angular, after.tolist(), strict=True):
        _step(space, cart, *speeds, dt)
        space.step(0.0)  # no time passes; adds and removes what callbacks asked for
        x, y, cart.angular_velocity = end
        cart.velocity = (x, y)
    return np.array([read_bodies(cart, block) for _, cart, block in worlds])


def _step(
    space: pymunk.Space, cart: pymunk.Body, linear: np.ndarray, angular: list[float], dt: float
) -> None:
    step, set_velocity, set_angular = lib.cpSpaceStep, lib.cpBodySetVelocity, lib.cpBodySetAngularVelocity
    c_space, c_cart = space._space, cart._body
    space._locked = True  # so that PyMunk defers what callbacks add or remove
    try:
        for velocity, turn in zip(ffi.from_buffer("cpVect[]", linear), angular, strict=True):
            set_velocity(c_cart, velocity)
            set_angular(c_cart, turn)
            step(c_space, dt)
    finally:
        space._locked = False


def read_bodies(*bodies: pymunk.Body) -> list[float]:
    """Return positions x, y, angle of each body (m, m, rad), then their velocities."""
    positions = [value for body in bodies for value in (*body.position, body.angle)]
    return positions + [value for body in bodies for value in (*body.velocity, body.angular_velocity)]
