"""Positions and velocities in the unit of a camera: pixels of the full frame, or metres."""

import numpy as np
import pytest
from films import film, make_poses

from dynmap_rl.data.camera import FrameSource, measure
from dynmap_rl.data.flow import flow_velocity
from dynmap_rl.data.tracking import track_objects

TIME = np.arange(10) / 20


@pytest.fixture(scope="module")
def frames():
    return film(make_poses(20))[10:, :80]  # 80 x 96 pixels


@pytest.mark.parametrize(
    ("width", "scale", "origin"),
    [
        (None, [2, 2, 1], [0.5, 0.5, 0]),  # the middle of the first pixel lies between four of the full frame
        (3.0, [3 / 96, -3 / 96, -1], [1.5 / 96, 2.5 - 1.5 / 96, 0]),  # from the lower left corner
    ],
)
def test_the_unit_is_that_of_the_camera(frames, width, scale, origin):
    tracks, flow = track_objects(frames, 2), FrameSource("flow", "front", 2, width=width)
    motion = measure(frames, (2, 2), flow, TIME)
    np.testing.assert_allclose(motion.position, (tracks.pose * scale + origin).reshape(10, 6))
    np.testing.assert_allclose(
        motion.velocity, (flow_velocity(frames, tracks, TIME) * scale).reshape(10, 6), atol=1e-12
    )
    assert motion.angles == [2, 5] and motion.other is None


@pytest.mark.parametrize("width", [None, 4.24])
def test_pixels_need_not_be_reduced_alike_in_both_directions(frames, width):
    """A picture of 424 x 240 pixels becomes one of 160 x 91."""
    square, other = (
        measure(frames, factor, FrameSource("centroid", "front", width=width), TIME).position
        for factor in ((2.65, 2.65), (2.65, 240 / 91))
    )
    np.testing.assert_allclose(other[:, 0], square[:, 0])
    np.testing.assert_allclose(np.ptp(other[:, 1]) / np.ptp(square[:, 1]), 240 / 91 / 2.65)
