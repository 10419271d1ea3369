"""Derivatives of positions."""

import numpy as np
import pytest

from dynmap_rl.data.derivatives import differentiate

EVEN = np.arange(20) / 25
UNEVEN = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.08, 20))


def parabola(t):
    return np.stack([1 + 2 * t - 3 * t**2, 0.5 * t**2], 1), np.stack([2 - 6 * t, t], 1), np.array([-6.0, 1.0])


@pytest.mark.parametrize("time", [EVEN, UNEVEN], ids=["even", "uneven"])
def test_central_differences_of_a_parabola_are_exact(time):
    position, velocity, acceleration = parabola(time)
    v, a = differentiate(position, time)
    assert np.abs(v - velocity).max() < 1e-10
    assert np.abs(a - acceleration).max() < 1e-8


def test_differences_at_the_ends_are_of_second_order_too():
    acceleration = differentiate((EVEN**3)[:, None], EVEN)[1][:, 0]
    assert np.abs(acceleration - 6 * EVEN).max() < 0.2  # 0.24 with differences of first order at the ends


def test_savgol_is_exact_up_to_its_order():
    t = EVEN[:, None]
    v, a = differentiate(t**4 - t**2, EVEN, "savgol", window=7, order=4)
    assert np.abs(v - (4 * t**3 - 2 * t)).max() < 1e-9
    assert np.abs(a - (12 * t**2 - 2)).max() < 1e-7


def test_savgol_is_closer_than_differences_where_positions_are_noisy():
    t = np.arange(200) / 25
    noisy = (np.sin(t) + 1e-3 * np.random.default_rng(0).standard_normal(200))[:, None]
    errors = [
        np.abs(differentiate(noisy, t, method)[1][:, 0] + np.sin(t)).mean()
        for method in ("central", "savgol")
    ]
    assert errors[1] < errors[0] / 3


def test_timestamps_of_float32_are_even_enough():
    t = (1000 + np.arange(50) / 30).astype(np.float32).astype(np.float64)
    v, _ = differentiate(t[:, None], t, "savgol")
    assert np.abs(v - 1).max() < 0.01


@pytest.mark.parametrize(
    ("time", "method", "message"),
    [
        (UNEVEN, "savgol", "--method central"),
        (EVEN[::-1], "central", "increase"),
        (EVEN[:2], "central", "3 steps .* got 2"),
        (EVEN[:10], "savgol", "11 steps .* got 10"),
    ],
)
def test_what_cannot_be_differentiated_is_refused(time, method, message):
    with pytest.raises(ValueError, match=message):
        differentiate(time[:, None], time, method)
