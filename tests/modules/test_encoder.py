"""Encoder and blocks of pixels."""

import shutil

import pytest
import torch
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from dynmap_rl.modules.encoder import GlimpseEncoder, PlainEncoder
from dynmap_rl.modules.layers import to_blocks


@pytest.mark.parametrize("make", [GlimpseEncoder, PlainEncoder])
def test_encoder_keeps_leading_axes_and_refuses_other_frames(make):
    encoder = make(16)
    frames = torch.randint(0, 256, (2, 3, 3, 64, 64), dtype=torch.uint8)
    latent = encoder(frames)
    assert latent.shape == (2, 3, 16)
    torch.testing.assert_close(encoder(frames[0, 0]), latent[0, 0], rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(encoder(frames.float()), latent, rtol=1e-4, atol=1e-5)
    assert encoder(frames[:0]).shape == (0, 3, 16) and encoder(frames[:0].float()).shape == (0, 3, 16)
    with pytest.raises(ValueError, match="32, 32"):
        encoder(torch.zeros(1, 3, 32, 32))
    with pytest.raises(ValueError, match="floats in -1"):
        encoder(frames.float() / 64 - 1)
    with pytest.raises(TypeError, match="must stay float32, got torch.bfloat16"):
        make(16).bfloat16()(frames)
    shifted = torch.cat([torch.zeros(1, dtype=torch.uint8), frames.flatten()])[1:].view(frames.shape)
    torch.testing.assert_close(encoder(shifted), latent)  # bytes that begin anywhere in memory


@pytest.mark.parametrize("make", [GlimpseEncoder, PlainEncoder])
@torch.no_grad()
def test_chunks_of_many_frames_have_the_latents_of_one_batch(make):
    encoder = make(16)
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
    encoder = PlainEncoder(16)
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


@torch.no_grad()
def test_attention_reads_position_and_colour_of_the_place_it_looks_at():
    """A map that looks at dark blocks alone finds where the dark block is, and its colour."""
    encoder = GlimpseEncoder(16, maps=1, glimpses=1, samples=4, spacing=1.0)
    frames = torch.full((1, 3, 64, 64), 255, dtype=torch.uint8)
    frames[0, :, 8:12, 40:44] = torch.tensor([30, 60, 90], dtype=torch.uint8)[:, None, None]
    attend = encoder.attend.register_forward_hook(
        lambda _m, _i, out: torch.zeros_like(out).index_put_(
            tuple(torch.tensor(i) for i in ((0,) * 4, range(4), (2,) * 4, (10,) * 4)), torch.tensor(100.0)
        )
    )
    seen = []
    encoder.linear.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][0]))
    encoder(frames)
    attend.remove()
    x, y, *color = (seen[0][:5] / 2).tolist()
    assert (x, y) == pytest.approx((42 / 32 - 1, 10 / 32 - 1), abs=1e-5)
    assert color == pytest.approx([v / 255 - 0.5 for v in (30, 60, 90)], abs=1e-5)
    glimpse = encoder.look(
        frames.float(), torch.tensor([[[x, y]]]), torch.zeros(1, 3)
    )  # rows, channels, columns
    assert (glimpse[0, 0].movedim(1, -1) == torch.tensor([30.0, 60.0, 90.0])).all()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a compiler")
@pytest.mark.parametrize("make", [GlimpseEncoder, PlainEncoder])
@torch.no_grad()
def test_a_compiled_encoder_gives_the_same(make):
    encoder, frames = make(16), torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    torch.testing.assert_close(torch.compile(encoder)(frames), encoder(frames), rtol=1e-4, atol=1e-4)


def test_floats_in_0_to_1_are_refused():
    encoder = PlainEncoder()
    frames = torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8)
    torch.testing.assert_close(encoder(frames.float()), encoder(frames), rtol=1e-4, atol=1e-4)
    with pytest.raises(ValueError, match="0..255"):
        encoder(frames / 255)
