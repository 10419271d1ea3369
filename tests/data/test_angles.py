"""Angles of several episodes."""

import numpy as np
import pytest

from dynmap_rl.data.angles import align_axes, align_turns
from dynmap_rl.data.motion import Motion
from dynmap_rl.data.tracking import Tracks


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
