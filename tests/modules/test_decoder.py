"""The decoder's sprites begin where the encoder's attention maps look."""

import pytest
import torch

from dynmap_rl.modules.decoder import SpriteDecoder
from dynmap_rl.modules.encoder import GlimpseEncoder


def middle(opacity: torch.Tensor) -> tuple[float, float]:
    """Return x and y of an image's centre of mass in -1..1."""
    line = (torch.arange(64) + 0.5) / 32 - 1
    weight = opacity / opacity.sum()
    return (weight.sum(0) @ line).item(), (weight.sum(1) @ line).item()


@torch.no_grad()
@pytest.mark.parametrize("x, y", [(-0.5, 0.25), (0.4, -0.3)])
def test_untrained_sprites_are_drawn_where_untrained_maps_look(x, y):
    torch.manual_seed(0)
    encoder, decoder = GlimpseEncoder(), SpriteDecoder(64)
    frame = torch.full((1, 3, 64, 64), 200, dtype=torch.uint8)
    column, row = round((x + 1) * 32), round((y + 1) * 32)
    frame[..., row - 2 : row + 2, column - 2 : column + 2] = torch.tensor([0, 200, 0]).byte()[:, None, None]
    latent = encoder(frame)
    with_dot = latent[0, : 2 * encoder.maps].view(-1, 2)
    without = encoder(torch.full_like(frame, 200))[0, : 2 * encoder.maps].view(-1, 2)
    moved = (with_dot - without) * torch.tensor([x, y]).sign()
    assert (moved > 0).all(), "every map turns to the rare colour"
    for place, sprite in zip(with_dot, decoder.draw_sprites(latent)[0], strict=True):
        assert middle(sprite[:, 3]) == pytest.approx(place.tolist(), abs=0.05)


@torch.no_grad()
def test_sprites_cover_the_canvas_in_order():
    torch.manual_seed(0)
    decoder, state = SpriteDecoder(8, sprites=3), torch.randn(2, 8)
    frames = decoder.draw_canvas(state)
    for sprite in decoder.draw_sprites(state).transpose(2, 3).unbind(1):
        frames = frames * (1 - sprite[:, 3:]) + sprite[:, :3]
    drawn = decoder(state[:, :4], state[:, 4:6], state[:, 6:])
    torch.testing.assert_close(drawn, frames)
