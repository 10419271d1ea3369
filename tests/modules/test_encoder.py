"""Encoder and blocks of pixels."""

import pytest
import torch
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from dynmap_rl.modules.encoder import Encoder, SpatialSoftmax
from dynmap_rl.modules.layers import to_blocks


@pytest.mark.parametrize("keypoints", [True, False])
def test_encoder_keeps_leading_axes_and_refuses_other_frames(keypoints):
    encoder = Encoder(16, keypoints=keypoints)
    frames = torch.randint(0, 256, (2, 3, 3, 64, 64), dtype=torch.uint8)
    latent = encoder(frames)
    assert latent.shape == (2, 3, 16)
    torch.testing.assert_close(encoder(frames[0, 0]), latent[0, 0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(encoder(frames.float()), latent, rtol=1e-4, atol=1e-5)
    with pytest.raises(ValueError, match="32, 32"):
        encoder(torch.zeros(1, 3, 32, 32))


@torch.no_grad()
def test_chunks_of_many_frames_have_the_latents_of_one_batch():
    encoder = Encoder(16)
    frames = torch.randint(0, 256, (70, 3, 64, 64), dtype=torch.uint8)
    with torch.enable_grad():
        whole = encoder(frames)
    torch.testing.assert_close(encoder(frames), whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "change", [lambda x: x, torch.Tensor.float, lambda x: x.repeat(1, 1, 1, 2)[..., 4:68]]
)
def test_frames_as_blocks_and_back(change):
    """The last frames are a part of a larger tensor in memory."""
    pixels = change(torch.randint(0, 256, (5, 3, 64, 64), dtype=torch.uint8))
    blocks = to_blocks(pixels)
    assert blocks.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(pixel_shuffle(blocks, 4), pixels)
    assert blocks[1, :, 2, 3].tolist() == pixels[1, :, 8:12, 12:16].flatten().tolist()


@torch.no_grad()
def test_a_frame_s_scale_and_colour_reach_the_latent():
    """Scaled weights on raw bytes equal plain weights on a frame in -0.5..0.5, except at the border."""
    encoder = Encoder(16)
    frames = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    frames[..., [0, -1], :] = frames[..., :, [0, -1]] = 0
    maps = encoder.stem(pixel_unshuffle(frames / 255 - 0.5, 4)).relu()[..., 1:-1, 1:-1]
    seen = []
    encoder.top.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][..., 1:-1, 1:-1]))
    latent = encoder(frames)
    torch.testing.assert_close(seen[0], maps, rtol=1e-4, atol=1e-5)
    encoder.project.register_forward_hook(lambda _m, _i, output: 0 * output)
    color = encoder(frames)
    torch.testing.assert_close(color, 5 * encoder.color(frames.float().mean((2, 3)) / 255 - 0.5))
    assert not torch.equal(latent, color)


def test_keypoints_are_where_the_map_is_bright():
    softmax = SpatialSoftmax(1, 1)
    torch.nn.init.constant_(softmax.logits.weight, 100.0)
    x = torch.zeros(1, 1, 8, 8)
    x[0, 0, 7, 0] = 1.0  # row 7, column 0
    assert softmax(x)[0].tolist() == pytest.approx([-1.0, 1.0])
