"""Latents are reused for frames that stay as they are, and for no others."""

import torch
from small import make_model

from dynmap_rl.evaluation.still import StillEncoder, reuse_still_frames


def draw(count, seed):
    return torch.randint(
        0, 256, (count, 3, 64, 64), dtype=torch.uint8, generator=torch.Generator().manual_seed(seed)
    )


@torch.no_grad()
def test_only_frames_that_changed_are_encoded(monkeypatch):
    model, counts = make_model().eval(), []
    encode, still = model.encoder.encode, StillEncoder(model.encoder)
    monkeypatch.setattr(model.encoder, "encode", lambda x: counts.append(len(x)) or encode(x))
    first, other = draw(4, 0), draw(4, 1)
    mixed = torch.where(torch.tensor([True, False, False, True])[:, None, None, None], other, first)
    one_pixel = mixed.clone()
    one_pixel[2, 0, 63, 63] += 1
    for frames in (first, first, mixed, one_pixel, mixed[:2], mixed):
        torch.testing.assert_close(still(frames), encode(frames))
    assert counts == [4, 2, 1, 2, 4]


@torch.no_grad()
def test_a_latent_that_was_returned_stays_as_it_is():
    still, frames = StillEncoder(make_model().eval().encoder), draw(2, 0)
    first = still(frames)
    kept, other = first.clone(), frames.clone()
    other[0] = 200
    still(other)
    assert torch.equal(first, kept)


@torch.no_grad()
def test_the_encoder_comes_back(tmp_path):
    model = make_model()
    encoder, names = model.encoder, list(model.state_dict())
    try:
        with reuse_still_frames(torch.nn.ModuleList([model])):
            assert isinstance(model.encoder, StillEncoder)
            torch.testing.assert_close(model.encode(draw(2, 0)), encoder(draw(2, 0)))
            raise KeyboardInterrupt
    except KeyboardInterrupt:
        assert model.encoder is encoder and list(model.state_dict()) == names
