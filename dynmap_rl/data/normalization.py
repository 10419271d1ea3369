"""Constants that map actions, goals and dynamics to [-1, 1]."""

from __future__ import annotations

import numpy as np
from tensordict import TensorDictBase

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.world import ACCELERATION_LIMIT, ACTION_LIMIT, VELOCITY_LIMIT


def normalization_constants(episodes: TensorDictBase) -> dict[str, dict[str, list[float]]]:
    """Compute the range of every quantity of the tasks, from the scene's natural scales.

    The natural ranges are the scene (0 to 1 m), half a radian, and the cart's limits of action, speed and
    acceleration, which are used for the block too. A range is widened about its middle where more than one in a
    thousand of the values lie beyond.

    Args:
        episodes: ``[E, T]`` training episodes, as :func:`dynmap_rl.data.load_dataset` returns them.

    Returns:
        ``low`` and ``high`` ``[D]`` of action, goal, position, velocity and acceleration, in SI units.
    """
    values = {name: episodes[name if name in ("action", "goal") else ("dynamics", name)] for name in NATURAL}
    return {name: planar_range(name, x.flatten(0, 1).double().numpy()) for name, x in values.items()}


NATURAL = {  # middle and half width; those of the dynamics repeat for every body
    "action": (np.zeros(3), ACTION_LIMIT),
    "goal": (np.full(2, 0.5), np.full(2, 0.5)),
    "position": (np.array([0.5, 0.5, 0.0]), np.full(3, 0.5)),
    "velocity": (np.zeros(3), VELOCITY_LIMIT),
    "acceleration": (np.zeros(3), ACCELERATION_LIMIT),
}


def planar_range(name: str, values: np.ndarray) -> dict[str, list[float]]:
    """Compute the range of one quantity of the tasks (see :func:`normalization_constants`).

    Args:
        name: ``action``, ``goal`` or a quantity of the dynamics.
        values: ``[N, D]``; entries of the dynamics are x, y and theta of one body after the other.

    Returns:
        ``low`` and ``high`` ``[D]``, in SI units.
    """
    middle, half = (np.resize(part, values.shape[1]) for part in NATURAL[name])
    reach = np.abs(values - middle)
    half = np.maximum(half, np.quantile(reach, 0.999, axis=0))
    return {"low": (middle - half).tolist(), "high": (middle + half).tolist()}


FLOORS = {"goal": 0.05, "position": 0.05, "velocity": 0.1, "acceleration": 1.0}  # m, m/s, m/s^2
TURNS = {"velocity": 1.0, "acceleration": 10.0}  # rad/s, rad/s^2


def layout_constants(episodes: TensorDictBase, layout: Layout) -> dict[str, dict[str, list[float]]]:
    """Compute the range of every quantity of the bodies of a task that is not in the plane.

    The three entries of a point or a vector, where all come in threes, share the width of their ranges, which holds all
    but one in a thousand of the values at either end, and is at least 0.1 m, 0.2 m/s and 2 m/s^2, or 2 rad/s and
    20 rad/s^2. So a body that hardly moves along an axis, or hardly turns, does not have its noise enlarged. Axes of bodies
    and actions have their natural ranges.

    Args:
        episodes: ``[E, T]`` training episodes, as :func:`dynmap_rl.data.load_dataset` returns them.
        layout: names of the entries.

    Returns:
        ``low`` and ``high`` ``[D]`` of action, goal, position, velocity and acceleration, in SI units.
    """
    limit = list(layout.action_limit)
    constants = {"action": {"low": [-x for x in limit], "high": limit}}
    names = {"goal": layout.state[-layout.goal_size :], **layout.dynamics}
    for quantity, entries in names.items():
        values = episodes["goal" if quantity == "goal" else ("dynamics", quantity)].flatten(0, 1)
        low, high = np.quantile(values.double().numpy(), [0.001, 0.999], axis=0)
        turning = np.array(["_omega_" in name for name in entries])
        least = np.where(turning, TURNS.get(quantity, 0.0), FLOORS[quantity])
        width = high - low
        if len(width) % 3 == 0:
            width = width.reshape(-1, 3).max(1).repeat(3)
        half = np.maximum(width / 2, least)
        middle = (low + high) / 2
        axis = np.array(["axis_" in name for name in entries])
        middle, half = np.where(axis, 0.0, middle), np.where(axis, 1.0, half)
        constants[quantity] = {"low": (middle - half).tolist(), "high": (middle + half).tolist()}
    return constants


def range_constants(episodes: TensorDictBase) -> dict[str, dict[str, list[float]]]:
    """Compute the range of every quantity of a robot dataset, from its values alone.

    A range holds all but one in a thousand of the values at either end. An entry that never changes gets a range of 1
    about its value. An entry that holds only noise is scaled to [-1, 1] like any other, and should not be chosen.

    Args:
        episodes: ``[E, T]`` training episodes with ``action``, ``goal`` and, optional, ``dynamics``.

    Returns:
        ``low`` and ``high`` ``[D]`` of action, goal and every quantity of the dynamics, in the dataset's units.
    """
    constants = {}
    for key in ("action", "goal", *(("dynamics", q) for q in episodes.get("dynamics", {}).keys())):
        values = episodes[key].flatten(0, 1).double().numpy()  # [N, D]
        constants[key[-1] if isinstance(key, tuple) else key] = value_range(values)
    return constants


def value_range(values: np.ndarray) -> dict[str, list[float]]:
    """Compute the range of values ``[N, D]`` (see :func:`range_constants`)."""
    low, high = np.quantile(values, [0.001, 0.999], axis=0)
    still = high - low <= 1e-6 * np.maximum(1, np.abs(high))
    low, high = np.where(still, low - 0.5, low), np.where(still, high + 0.5, high)
    return {"low": low.tolist(), "high": high.tolist()}
