"""World model loss: its terms, their scale, and the time step that each term compares."""

import pytest
import torch
from small import CONSTANTS
from tensordict import TensorDict

from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.objectives import world_model as objectives
from dynmap_rl.objectives.world_model import WorldModelLoss, rms

CONSTANTS = CONSTANTS | {q: {"low": [-2.0] * 6, "high": [2.0] * 6} for q in DYNAMICS}


def batch(b=2, t=5):
    return TensorDict(
        {
            "pixels": torch.randint(0, 256, (b, t, 3, 64, 64), dtype=torch.uint8),
            "action": 0.02 * torch.randn(b, t, 3),
            "dynamics": {q: torch.rand(b, t, 6) for q in DYNAMICS},
        },
        [b, t],
    )


def make(supervision=DYNAMICS, **arguments):
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, supervision, latent_size=16, hidden_size=24)
    return model, WorldModelLoss(model, **arguments)


@pytest.mark.parametrize("supervision", [(), ("velocity", "acceleration"), DYNAMICS])
def test_the_losses_are_those_of_the_supervision(supervision):
    _, loss = make(supervision)
    losses = loss(batch())
    assert set(losses.keys()) == {"loss_rgb", "loss_latent", *(f"loss_{q}" for q in supervision)}
    assert all(value.shape == () and value > 0 for value in losses.values())


@torch.no_grad()
def test_dynamics_loss_is_the_norm_of_the_normalised_error_from_t_1_on():
    model, loss = make(("velocity",))
    td = batch()
    states = model.predict(model.encode(td["pixels"]), td["action"])
    error = (model.decode_dynamics(*states)["velocity"] - td["dynamics", "velocity"]) / 2.0
    expected = error[:, 1:].norm(dim=-1).mean() / 6**0.5
    torch.testing.assert_close(loss(td)["loss_velocity"], expected, rtol=1e-4, atol=1e-6)
    td["dynamics", "velocity"][:, 0] += 100.0  # there is no prediction for t = 0
    torch.testing.assert_close(loss(td)["loss_velocity"], expected, rtol=1e-4, atol=1e-6)


def test_a_model_that_copies_its_input_frame_predicts_a_delayed_sequence_only():
    """An off-by-one in the comparison would fail here."""
    _, loss = make(())
    frames = torch.randint(0, 256, (1, 6, 3, 64, 64), dtype=torch.uint8)
    # The prediction for t is the frame of t - 1.
    loss.world_model.decode_pixels = lambda *_: frames[:, :-1] / 255
    td = TensorDict({"pixels": frames, "action": torch.zeros(1, 6, 3)}, [1, 6])
    assert loss(td)["loss_rgb"] > 0.1
    td["pixels"] = torch.cat([frames[:, :1], frames[:, :-1]], 1)
    assert loss(td)["loss_rgb"] < 1e-3


def test_stop_gradient_keeps_the_latent_loss_out_of_the_target():
    model, loss = make((), beta_z=1.0, stop_gradient=True)
    torch.nn.init.zeros_(model.transition.change.weight)
    loss(batch())["loss_latent"].backward()
    assert model.transition.change.bias.grad.abs().sum() > 0
    assert all(p.grad is None or p.grad.abs().sum() == 0 for p in model.encoder.parameters())
    model, loss = make((), beta_z=1.0, stop_gradient=False)
    loss(batch())["loss_latent"].backward()
    assert any(p.grad.abs().sum() > 0 for p in model.encoder.parameters())


def test_weights_scale_their_terms():
    torch.manual_seed(1)
    td = batch()
    _, plain = make(("position",), beta_z=1.0, beta_dynamics=1.0)
    _, heavy = make(("position",), beta_z=2.0, beta_dynamics=3.0, beta_rgb=4.0)
    torch.testing.assert_close(heavy(td)["loss_rgb"], 4 * plain(td)["loss_rgb"])
    torch.testing.assert_close(heavy(td)["loss_latent"], 2 * plain(td)["loss_latent"])
    torch.testing.assert_close(heavy(td)["loss_position"], 3 * plain(td)["loss_position"])


def test_the_loss_of_the_dynamics_is_the_mean_over_the_labelled_steps():
    td = batch(b=3)
    _, loss = make(("position",))
    alone = loss(td[:1])["loss_position"]
    td["labelled"] = torch.tensor([True, False, False])[:, None, None].expand(3, 5, 1)
    found = loss(td)
    torch.testing.assert_close(found["loss_position"], alone)
    td["labelled"] = torch.zeros(3, 5, 1, dtype=torch.bool)
    none = loss(td)
    assert none["loss_position"] == 0 and none["loss_latent"] == found["loss_latent"]


@pytest.mark.parametrize("mask", ["labelled", ("collector", "mask")])
def test_unknown_dynamics_may_be_nan(mask):
    td, (_, loss) = batch(), make(("position",))
    td[mask] = torch.rand(2, 5, 1) > 0.4 if mask == "labelled" else torch.rand(2, 5) > 0.4
    losses = []
    for value in (0.0, torch.nan):
        known = td[mask].reshape(2, 5, 1)
        td["dynamics", "position"] = td["dynamics", "position"].where(known, torch.tensor(value))
        loss.zero_grad()
        losses.append(loss(td)["loss_position"])
        losses[-1].backward()
        assert all(p.grad.isfinite().all() for p in loss.parameters() if p.grad is not None)
    assert losses[0] == losses[1]


def test_entries_that_are_not_labelled_have_no_effect_and_others_have():
    td, (_, loss) = batch(), make(("position",))
    size = td["dynamics", "position"].shape[-1]
    td["labelled"] = (torch.arange(size) < 3).expand(2, 5, size)  # the cart, as where the block is hidden
    expected = loss(td)["loss_position"]
    td["dynamics", "position"][..., 3:] = torch.nan
    torch.testing.assert_close(loss(td)["loss_position"], expected)
    loss(td)["loss_position"].backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters() if p.grad is not None)
    td["dynamics", "position"][..., :3] += 1.0
    assert loss(td)["loss_position"] > expected


def test_a_call_with_tensors_is_that_with_a_tensordict():
    td, (_, loss) = batch(t=6), make(())
    torch.manual_seed(0)
    expected = [value for _, value in loss(td).items()]
    torch.manual_seed(0)
    found = loss(pixels=td["pixels"], action=td["action"])
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_labels_belong_to_their_own_step():
    td, (_, loss) = batch(), make(("position",))
    td["labelled"] = (torch.arange(5) == 2).expand(2, 5)[..., None]
    expected = loss(td)["loss_position"].item()
    td["dynamics", "position"][:, [1, 3, 4]] += 1.0
    assert loss(td)["loss_position"].item() == pytest.approx(expected)
    td["dynamics", "position"][:, 2] += 1.0
    assert loss(td)["loss_position"].item() != pytest.approx(expected)


def test_without_the_rgb_loss_no_frame_is_decoded():
    model, loss = make(("position",), beta_rgb=0.0)
    model.decode_pixels = None
    assert set(loss(batch()).keys()) == set(loss.out_keys) == {"loss_latent", "loss_position"}


def test_rarity_makes_an_error_on_a_small_object_count():
    pixels = torch.full((1, 3, 3, 64, 64), 255, dtype=torch.uint8)
    pixels[..., :4, :4] = 0
    td = TensorDict({"pixels": pixels, "action": torch.zeros(1, 3, 3)}, [1, 3])
    losses = []
    for rarity in (0.0, 1.0):
        _, loss = make((), rarity=rarity)
        loss.world_model.decode_pixels = lambda *_: torch.ones(1, 2, 3, 64, 64)
        losses.append(loss(td)["loss_rgb"].item())
    assert losses == pytest.approx([1 / 16, 0.5**0.5], abs=1e-4)


def test_rms_has_a_gradient_at_zero():
    x = torch.zeros(3, requires_grad=True)
    rms(x).backward()
    assert x.grad.isfinite().all()


def test_imagined_windows_read_no_frames_after_their_context():
    """With the same encoder, frames at the end of imagined windows change nothing but what is compared with them."""
    torch.manual_seed(0)
    td = batch(b=4, t=6)
    _, loss = make(("position",), imagined=1.0)
    losses = []
    for frame in (0, 255):
        td["pixels"][:, -2] = frame  # the last step is predicted from its frame, or from a prediction
        loss.generator = torch.Generator().manual_seed(3)
        losses.append(loss(td)["loss_position"].item())
    context = torch.randint(1, 6, (1,), generator=torch.Generator().manual_seed(3)).item()
    assert context <= 4 and losses[0] == losses[1]
    _, seen = make(("position",), imagined=0.0)
    first = seen(td)["loss_position"].item()
    td["pixels"][:, -2] = 0
    assert seen(td)["loss_position"].item() != first


def test_only_the_first_windows_are_imagined_and_from_any_step_on(monkeypatch):
    td, contexts = batch(t=6), set()
    td["labelled"] = torch.tensor([False, True])[:, None, None].expand(2, 6, 1)
    model, loss = make(("position",), imagined=0.5, generator=torch.Generator().manual_seed(0))
    seen = WorldModelLoss(model)(td)["loss_position"].item()
    imagine = model.transition.imagine
    monkeypatch.setattr(
        model.transition, "imagine", lambda z, action, n: contexts.add(n) or imagine(z, action, n)
    )
    for _ in range(40):
        assert loss(td)["loss_position"].item() == pytest.approx(seen, rel=1e-4)
    assert contexts == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 12])
def test_as_many_windows_are_imagined_in_any_number_of_processes(monkeypatch, count):
    model, loss = make(("position",), imagined=0.5, distributed=True)
    td, imagined = batch(b=12 // count), []
    imagine = model.transition.imagine
    monkeypatch.setattr(
        model.transition, "imagine", lambda z, action, n: imagined.append(len(z)) or imagine(z, action, n)
    )
    monkeypatch.setattr(objectives, "ranks", lambda: count)
    with torch.no_grad():
        for rank in range(count):
            monkeypatch.setattr(objectives, "rank", lambda rank=rank: rank)
            loss(td)
    assert sum(imagined) == 6


def test_the_latent_loss_of_imagined_windows_moves_the_predicted_change_alone():
    model, loss = make((), beta_z=1.0, imagined=1.0)
    torch.nn.init.zeros_(model.transition.change.weight)
    loss(batch())["loss_latent"].backward()
    assert model.transition.change.bias.grad.abs().sum() > 0.1
    assert all(p.grad is None or p.grad.abs().sum() < 1e-5 for p in model.encoder.parameters())
