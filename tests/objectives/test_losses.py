import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import pixel_unshuffle

from dynmap_rl.modules.decoder import DYNAMICS
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.objectives.imitation import imitation_loss
from dynmap_rl.objectives.world_model import rms

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    **{q: {"low": [-2.0] * 6, "high": [2.0] * 6} for q in DYNAMICS},
}


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


@pytest.mark.parametrize("supervision", [(), ("position",), ("velocity", "acceleration"), DYNAMICS])
def test_the_losses_are_those_of_the_supervision(supervision):
    _, loss = make(supervision)
    losses = loss(batch())
    assert set(losses.keys()) == {"loss_rgb", "loss_latent", *(f"loss_{q}" for q in supervision)}
    assert all(value.shape == () and value > 0 for value in losses.values())


@torch.no_grad()
def test_dynamics_loss_is_the_paper_s_norm_of_the_normalised_error_from_t_1_on():
    model, loss = make(("velocity",))
    td = batch()
    states = model.predict(model.encode(td["pixels"]), td["action"])
    error = (model.decode_dynamics(*states)["velocity"] - td["dynamics", "velocity"]) / 2.0
    expected = error[:, 1:].norm(dim=-1).mean() / 6**0.5
    torch.testing.assert_close(loss(td)["loss_velocity"], expected, rtol=1e-4, atol=1e-6)
    td["dynamics", "velocity"][:, 0] += 100.0  # there is no prediction for t = 0
    torch.testing.assert_close(loss(td)["loss_velocity"], expected, rtol=1e-4, atol=1e-6)


def test_an_off_by_one_would_be_seen():
    """A model that copies its input frame predicts a sequence shifted by one step, and only that one, exactly."""
    _, loss = make(())
    frames = torch.randint(0, 256, (1, 6, 3, 64, 64), dtype=torch.uint8)
    # What stood at t - 1:
    loss.world_model.image_decoder.decode_blocks = lambda *_: pixel_unshuffle(frames[:, :-1] / 255 - 0.5, 4)
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
    _, heavy = make(("position",), beta_z=2.0, beta_dynamics=3.0)
    torch.testing.assert_close(heavy(td)["loss_latent"], 2 * plain(td)["loss_latent"])
    torch.testing.assert_close(heavy(td)["loss_position"], 3 * plain(td)["loss_position"])


def test_keys_can_be_renamed():
    _, loss = make(("position",))
    td = batch().rename_key_("pixels", "frame").rename_key_("dynamics", "truth")
    loss.set_keys(pixels="frame", dynamics="truth")
    assert loss(td)["loss_position"] > 0


def test_imitation_loss_is_the_mean_absolute_error_in_normalised_units():
    normalizer = Normalizer([-2.0, -4.0], [2.0, 4.0])
    predicted, action = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 2.0]])
    assert imitation_loss(predicted, action, normalizer).item() == pytest.approx(0.5)


def test_emphasis_weighs_the_steps_in_which_the_action_changes():
    normalizer = Normalizer([-1.0], [1.0])
    action = torch.tensor([[[0.0], [0.5], [0.5]]])
    wrong_at = [torch.zeros(1, 3, 1).index_fill(1, torch.tensor([t]), 1.0) for t in range(3)]
    losses = [imitation_loss(action + error, action, normalizer, emphasis=4.0).item() for error in wrong_at]
    assert losses == pytest.approx([0.2, 0.6, 0.2])  # weights 1, 1 + 4 / 2, 1
    moving_from_the_start = [
        imitation_loss(action + e + 0.5, action + 0.5, normalizer, emphasis=4.0) for e in wrong_at
    ]
    assert moving_from_the_start[0] == moving_from_the_start[1] > moving_from_the_start[2]


def test_ignored_steps_do_not_count_however_much_they_are_emphasised():
    normalizer = Normalizer([-1.0], [1.0])
    action, error = torch.tensor([[[0.5], [0.5]]]), torch.tensor([[[1.0], [0.0]]])
    ignore = torch.tensor([[[True], [False]]])
    assert imitation_loss(action + error, action, normalizer, ignore, emphasis=4.0) == 0


@pytest.mark.parametrize("ignore", [[True, False], [True, True]])
def test_what_is_ignored_may_be_anything(ignore):
    """NaN in an ignored step, and no step that counts: a number, and gradients that are."""
    action = torch.tensor([[[torch.nan], [0.5]]])
    predicted = torch.zeros(1, 2, 1, requires_grad=True)
    mask = torch.tensor(ignore).view(1, 2, 1)
    loss = imitation_loss(predicted, action, Normalizer([-1.0], [1.0]), mask)
    loss.backward()
    assert loss == (0.0 if all(ignore) else 0.5) and predicted.grad.isfinite().all()


def test_rms_has_a_gradient_at_zero():
    x = torch.zeros(3, requires_grad=True)
    rms(x).backward()
    assert x.grad.isfinite().all()
