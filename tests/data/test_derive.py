"""Derivatives of positions."""

import numpy as np
import pytest

from dynmap_rl.data.angles import align_axes, align_turns
from dynmap_rl.data.derive import _derive, differentiate
from dynmap_rl.data.motion import Motion
from dynmap_rl.data.tracking import Tracks

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


def test_an_angle_in_degrees_jumps_by_360():
    angle = (400 * EVEN[:, None] + 180) % 360 - 180  # 16 in a step, which is not a jump
    found, _ = _derive(Motion(angle, [0], 360), EVEN, "central", 11, 3)
    np.testing.assert_allclose(found["velocity"], 400)


def test_a_pose_has_one_angle_in_all_episodes():
    """Episodes that begin near the border of the measured range, which a gripper that points down does."""
    true = np.pi + 0.5 * np.sin(np.arange(60) / 5) + np.repeat([0.1, -0.1, 0.05], 20)
    rows = [slice(0, 20), slice(20, 40), slice(40, 60)]
    angle = np.concatenate([np.unwrap((true[r] + np.pi) % (2 * np.pi) - np.pi) for r in rows])
    assert np.ptp(angle - true) > 6
    align_turns(angle[:, None], rows, 2 * np.pi)
    assert np.ptp(angle - true) < 1e-9
    degrees = np.array([[-170.0], [170.0]])
    align_turns(degrees, [slice(0, 1), slice(1, 2)], 360.0)
    assert np.ptp(degrees) == pytest.approx(20)


def test_a_joint_within_its_limits_stays_as_measured():
    """An episode whose mean is far from that of the others."""
    angle = np.concatenate([np.linspace(-2.7, 2.7, 50), *[np.linspace(1.5, 2.6, 20)] * 3, np.full(20, -2.4)])
    rows, found = [slice(0, 50), *(slice(50 + 20 * i, 70 + 20 * i) for i in range(4))], angle[:, None].copy()
    align_turns(found, rows, 2 * np.pi)
    np.testing.assert_array_equal(found[:, 0], angle)


def test_episodes_that_together_go_all_the_way_round_agree_where_they_begin():
    angle = np.concatenate([np.linspace(0, 3.5, 20), 2 * np.pi + np.linspace(0.1, -3.5, 20)])[:, None]
    align_turns(angle, [slice(0, 20), slice(20, 40)], 2 * np.pi)
    assert angle[20, 0] - angle[0, 0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    "degrees", [(60, 30, 45, 50), (95, 80, 88, 100), (-5, 4, 0, 10), (170, -170, 178, 5)]
)
def test_an_axis_has_one_angle_in_all_episodes(degrees):
    turn = np.radians(np.linspace(0, 30, 20))
    true = np.concatenate([np.radians(start) + turn for start in degrees])
    starts, rows = np.radians(degrees), [slice(20 * i, 20 * i + 20) for i in range(4)]
    measured = np.concatenate([s - np.pi * np.round(s / np.pi) + turn for s in starts])[:, None]
    tracks = Tracks(None, None, None, None, None, np.array([2.0]), None, 0.1)
    motion = Motion(None, [0], found=np.ones((20, 1), bool), tracks=tracks)
    align_axes(measured, [(own, motion) for own in rows])
    offset = (measured[:, 0] - true) / np.pi
    away = np.abs(offset - offset[0])
    np.testing.assert_allclose(away, np.round(away), atol=1e-9)  # the same axis in all episodes
    assert np.ptp(measured) < np.radians(65 + 30), "and no half turn between them"
    assert abs(np.median(measured[::20])) <= np.pi / 4 + 1e-9


def test_the_acceleration_of_a_measured_velocity_is_its_derivative():
    position, velocity, acceleration = parabola(EVEN)
    found, motion = _derive(Motion(0 * position, [], velocity=velocity), EVEN, "central", 11, 3)
    np.testing.assert_allclose(found["acceleration"], np.broadcast_to(acceleration, (20, 2)))
    assert found["velocity"] is velocity and not motion.other.any()


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
