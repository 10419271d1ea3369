"""Animations, frame by frame."""

import numpy as np
import torch
from PIL import Image, ImageSequence

from dynmap_rl.reporting.media import save_gif


def test_episodes_are_side_by_side(tmp_path):
    shades = torch.arange(3)[:, None] * 60 + torch.arange(2) * 20  # of episode and step
    pixels = shades.to(torch.uint8)[..., None, None, None].expand(3, 2, 3, 4, 5).contiguous()
    save_gif(pixels, tmp_path / "a/x.gif", columns=2, scale=2)
    film = Image.open(tmp_path / "a/x.gif")
    frames = [np.asarray(frame.convert("L"), int) for frame in ImageSequence.Iterator(film)]
    assert [frame.shape for frame in frames] == [(16, 20)] * 2
    for t, frame in enumerate(frames):
        corners = [frame[4, 5], frame[4, 15], frame[12, 5], frame[12, 15]]
        np.testing.assert_allclose(corners, [20 * t, 60 + 20 * t, 120 + 20 * t, 255], atol=3)
