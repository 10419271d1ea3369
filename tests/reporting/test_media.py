"""Animations, frame by frame."""

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from dynmap_rl.reporting.media import save_gif


def test_episodes_are_side_by_side(tmp_path):
    shades = torch.arange(3)[:, None] * 60 + torch.arange(2) * 20  # of episode and step
    pixels = shades.to(torch.uint8)[..., None, None, None].expand(3, 2, 3, 4, 5).contiguous()
    save_gif(pixels, tmp_path / "a/x.gif", 0.05, columns=2, scale=2)
    film = Image.open(tmp_path / "a/x.gif")
    frames = [np.asarray(frame.convert("L"), int) for frame in ImageSequence.Iterator(film)]
    assert [frame.shape for frame in frames] == [(16, 20)] * 2
    for t, frame in enumerate(frames):
        corners = [frame[4, 5], frame[4, 15], frame[12, 5], frame[12, 15]]
        np.testing.assert_allclose(corners, [20 * t, 60 + 20 * t, 120 + 20 * t, 255], atol=3)


@pytest.mark.parametrize(("dt", "steps"), [(0.05, 20), (0.04, 50), (0.0125, 81)])
def test_an_animation_lasts_as_long_as_its_episodes_and_ends_with_their_last_frame(tmp_path, dt, steps):
    shades = torch.arange(steps, dtype=torch.uint8)[None, :, None, None, None]
    save_gif(shades.expand(1, steps, 3, 4, 4).contiguous(), tmp_path / "x.gif", dt, columns=1, scale=1)
    film = Image.open(tmp_path / "x.gif")
    seconds = sum(frame.info["duration"] for frame in ImageSequence.Iterator(film)) / 1000
    assert seconds == pytest.approx(steps * dt, abs=0.025)  # a duration in a file is a multiple of 10 ms
    assert np.asarray(film.convert("L"), int)[0, 0] == pytest.approx(steps - 1, abs=2)
