"""World models of larger frames, and of frames of several cameras side by side."""

import pytest
import torch
from small import CONSTANTS

from dynmap_rl.modules.checkpoints import load_world_model, make_world_model, save_world_model
from dynmap_rl.modules.decoder import SpriteDecoder
from dynmap_rl.modules.encoder import GlimpseEncoder


def make(**arguments):
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, ("position",), latent_size=8, hidden_size=12, **arguments)


def draw(*shape):
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("architecture", ["glimpse", "plain"])
@pytest.mark.parametrize(("size", "cameras"), [(64, 2), (96, 1), (128, 2)])
def test_frames_of_any_size_and_number_pass_through(tmp_path, architecture, size, cameras):
    model = make(architecture=architecture, image_size=size, cameras=cameras)
    pixels = draw(2, 3, 3, size, size * cameras)
    latent = model.encode(pixels)
    assert latent.shape == (2, 3, 8)
    states = model.predict(latent, torch.zeros(2, 3, 3))
    assert model.decode_pixels(*states).shape == pixels.shape
    save_world_model(tmp_path, model)
    loaded = load_world_model(tmp_path)
    assert (loaded.image_size, loaded.cameras) == (size, cameras)
    torch.testing.assert_close(loaded.encode(pixels), model.eval().encode(pixels))
    with pytest.raises(ValueError, match="pixels must be"):
        model.encode(draw(2, 3, 3, size, size * cameras + size))


def test_the_latent_depends_on_every_camera():
    model, pixels = make(cameras=2).eval(), draw(1, 3, 64, 128)
    for place in (slice(0, 64), slice(64, 128)):
        other = pixels.clone()
        other[..., place] = 255 - other[..., place]
        assert not torch.allclose(model.encode(other), model.encode(pixels))


@torch.no_grad()
def test_glimpses_and_sprites_cover_the_same_part_of_larger_frames():
    seen = []
    for size in (64, 128):
        encoder = GlimpseEncoder(8, samples=4, image_size=size)
        frame = torch.zeros(1, 3, size, size)
        frame[..., : size // 2] = 1.0  # left half
        seen.append(encoder.look(frame, torch.zeros(1, 1, 2), torch.zeros(1, 3)))
    torch.testing.assert_close(*seen)
    drawn = []
    for size in (64, 128):
        torch.manual_seed(0)
        decoder = SpriteDecoder(4, sprites=1, image_size=size)
        decoder.place.weight.zero_()
        decoder.place.bias.zero_()
        torch.manual_seed(1)
        for module in (decoder.paint, decoder.tint):
            for parameter in module.parameters():
                torch.nn.init.normal_(parameter, std=0.1)
        drawn.append(decoder.draw_sprites(torch.ones(1, 4)))
    shares = [(sprite[0, 0, :, 3] > 0).float().mean().item() for sprite in drawn]
    assert shares[0] == pytest.approx(shares[1], abs=0.05)
    small, large = (sprite[0].transpose(1, 2) for sprite in drawn)
    assert (torch.nn.functional.avg_pool2d(large, 2) - small)[..., 24:40, 24:40].abs().mean() < 0.1


@pytest.mark.parametrize(
    "size",
    [
        {"image_size": 60},
        {"image_size": 0},
        {"image_size": 96.0},
        {"cameras": 0},
        {"latent_size": 0},
        {"hidden_size": 1.5},
    ],
)
def test_sizes_that_cannot_be_are_refused(size):
    with pytest.raises(ValueError, match=f"{next(iter(size))} must be"):
        make_world_model(CONSTANTS, ("position",), **size)


@torch.no_grad()
def test_latents_of_cameras_are_rolled_and_added():
    """Saved models of several cameras depend on it."""
    model, pixels = make(cameras=2).eval(), draw(1, 3, 64, 128)
    first, second = (
        encoder(part) for encoder, part in zip(model.encoder.encoders, pixels.split(64, -1), strict=True)
    )
    torch.testing.assert_close(model.encode(pixels), first + second.roll(4, -1))


@pytest.mark.parametrize("architecture", ["glimpse", "plain"])
@torch.no_grad()
def test_latents_are_rolled_back_for_the_decoders_of_cameras(architecture):
    """Saved models of several cameras depend on it."""
    model = make(architecture=architecture, cameras=2).eval()
    states = model.predict(model.encode(draw(2, 3, 3, 64, 128)), torch.zeros(2, 3, 3))
    shown = model.decode_pixels(*states)
    latent, *hidden = states
    first, second = model.image_decoder.decoders
    frames = first(latent, *hidden), second(latent.roll(-4, -1), *hidden)
    torch.testing.assert_close(shown, torch.cat(frames, -1))
