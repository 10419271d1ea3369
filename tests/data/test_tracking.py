"""Positions from frames."""

import numpy as np
import pytest
from robot_dataset import draw

from dynmap_rl.data.tracking import track_centroid


def test_a_square_is_found_to_half_a_pixel_though_it_rests_for_most_of_the_time():
    way = np.linspace(0.2, 0.8, 40)
    positions = np.stack([np.concatenate([way, np.full(100, 0.8)]), np.full(140, 0.5)], 1)
    track = track_centroid(np.stack([draw(p) for p in positions]))
    error = np.abs(track[:, 0] - (positions[:, 0] * 128 - 0.5))
    assert error[5:35].max() < 1.5  # where it neither starts nor ends, in the background
    assert np.median(error) < 1.5


def test_a_picture_in_which_nothing_moves_is_refused():
    with pytest.raises(ValueError, match="nothing moves"):
        track_centroid(np.stack([draw(np.array([0.5, 0.5]))] * 10))
