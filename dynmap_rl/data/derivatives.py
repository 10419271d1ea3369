"""Velocities and accelerations from positions."""

from __future__ import annotations

import numpy as np

METHODS = ("central", "savgol")


def differentiate(
    position: np.ndarray, time: np.ndarray, method: str = "central", window: int = 11, order: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Compute velocity and acceleration from positions.

    Both methods use later steps: the results are labels, and no policy may read them.

    Args:
        position: positions ``[T, D]`` of one episode, float64.
        time: their times ``[T]`` (s).
        method: ``central`` (differences over both neighbours by ``numpy.gradient``, of second order at uneven times
            too, twice for the acceleration) or ``savgol`` (derivatives of a polynomial fitted to each window, for noisy
            positions at even times).
        window: steps of the window of ``savgol``.
        order: order of the polynomial of ``savgol``.

    Returns:
        Velocity and acceleration ``[T, D]``, per s and per s^2, float64.

    Raises:
        ValueError: there are too few steps, or times do not increase or, for ``savgol``, are not uniform.
    """
    from scipy.signal import savgol_filter

    steps = np.diff(time)
    needed = window if method == "savgol" else 3
    if len(position) < needed:
        raise ValueError(
            f"positions must have at least {needed} steps for --method {method}, got {len(position)}"
        )
    if not (steps > 0).all():
        raise ValueError("timestamps must increase")
    if method == "central":
        velocity = np.gradient(position, time, axis=0, edge_order=2)
        return velocity, np.gradient(velocity, time, axis=0, edge_order=2)
    if not is_uniform(time):
        raise ValueError(
            f"timestamps must be uniform for --method savgol, got distances of {steps.min():.4g} to "
            f"{steps.max():.4g} s; use --method central"
        )
    mean = (time[-1] - time[0]) / (len(time) - 1)
    velocity, acceleration = (savgol_filter(position, window, order, k, mean, axis=0) for k in (1, 2))
    return velocity, acceleration


def is_uniform(time: np.ndarray) -> bool:
    """Return whether times ``[T]`` (s) are uniform, as far as float32, in which datasets store them, allows."""
    steps, mean = np.diff(time), (time[-1] - time[0]) / (len(time) - 1)
    return bool(np.abs(steps - mean).max() <= 0.01 * mean + 2 * np.spacing(np.float32(time[-1])))


def check_method(method: str, window: int, order: int) -> None:
    """Raise ``ValueError`` for an unknown method, or a window or an order that does not fit."""
    if method not in METHODS:
        raise ValueError(f"--method must be one of {', '.join(METHODS)}, got {method!r}")
    if method == "savgol" and not (window % 2 and 2 <= order < window):
        raise ValueError(
            f"--window must be odd and --order at least 2 and below --window, got {window} and {order}"
        )
