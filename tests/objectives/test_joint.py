"""Joint and end-to-end losses: their terms, and the weights that each term trains (paper, Eq. 3 and 4)."""

import pytest
import torch
from small import CONSTANTS, make_episodes, make_model

from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.objectives import joint, world_model
from dynmap_rl.objectives.imitation import imitation_loss
from dynmap_rl.objectives.joint import JointLoss
from dynmap_rl.objectives.world_model import WorldModelLoss


@pytest.fixture
def td():
    return make_episodes(2, 5)["train"].clone()


def make(kind="recurrent", **arguments):
    model = make_model()
    policy = make_policy(CONSTANTS, kind, model, width=16)
    return JointLoss(WorldModelLoss(model), policy, **arguments), model, policy


def moved(module: torch.nn.Module) -> bool:
    return any(p.grad is not None and bool(p.grad.any()) for p in module.parameters())


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
def test_end_to_end_trains_encoder_transition_and_policy_by_the_policys_loss(td, kind):
    loss, model, policy = make(kind, end_to_end=True)
    losses = loss(td)
    assert list(losses.keys()) == ["loss_policy"]
    losses["loss_policy"].backward()
    assert moved(model.encoder) and moved(model.transition.lstm) and moved(policy)
    assert not moved(model.image_decoder) and not moved(model.dynamics_decoder)
    model.zero_grad()
    loss(td[:, :1])["loss_policy"].backward()  # by the latent alone: hidden states begin as zeros
    assert moved(model.encoder)


def test_joint_is_the_world_model_loss_and_the_weighted_policy_loss(td):
    loss, model, policy = make(beta_joint=3.0, emphasis=9.0)
    losses = loss(td)
    for name, value in WorldModelLoss(model)(td).items():
        torch.testing.assert_close(losses[name], value)
    latent = model.encode(td["pixels"])
    _, hidden1, hidden2 = model.predict(latent, td["action"])
    predicted = policy(latent, hidden1, hidden2, td["goal"])
    expected = 3 * imitation_loss(predicted, td["action"], policy.action, emphasis=9.0)
    torch.testing.assert_close(losses["loss_policy"], expected)
    sum(losses.values()).backward()
    assert all(map(moved, (model.encoder, model.image_decoder, model.dynamics_decoder, policy)))


def test_the_first_step_of_a_window_within_an_episode_has_no_emphasis(td):
    loss, *_ = make(end_to_end=True, emphasis=9.0)
    td["step_count"] = torch.arange(5)[:, None].repeat(2, 1, 1)
    begins = loss(td)["loss_policy"]
    td["step_count"] += 7
    assert not torch.isclose(loss(td)["loss_policy"], begins, rtol=1e-3)


def test_imagined_steps_are_refused():
    with pytest.raises(ValueError, match="imagined = 0, got 0.5"):
        JointLoss(WorldModelLoss(make_model(), imagined=0.5), make()[2])


def test_without_weight_the_world_model_learns_as_alone(td):
    loss, model, _ = make(beta_joint=0.0)
    sum(loss(td).values()).backward()
    joint = [p.grad.clone() for p in model.parameters()]
    model.zero_grad()
    sum(WorldModelLoss(model)(td).values()).backward()
    for a, b in zip(joint, (p.grad for p in model.parameters()), strict=True):
        torch.testing.assert_close(a, b)


def test_disturbed_steps_do_not_count_for_the_policy(td):
    loss, *_ = make(end_to_end=True)
    td["disturbed"] = torch.zeros(2, 5, 1, dtype=torch.bool)
    plain = loss(td)["loss_policy"].item()
    td["disturbed"][:, -1] = True  # no later state depends on the last action
    ignored = loss(td)["loss_policy"].item()
    td["action"][:, -1] += 1.0
    assert ignored != plain
    assert loss(td)["loss_policy"].item() == pytest.approx(ignored)


def test_a_loss_does_not_wait_for_other_processes(td, monkeypatch):
    """A group of processes may belong to a collector, whose other processes compute no losses."""
    for module in (joint, world_model):
        monkeypatch.setattr(module, "mean_over_ranks", None)
    monkeypatch.setattr(world_model, "ranks", lambda: 2)
    loss, *_ = make()
    td["labelled"] = torch.rand(*td.shape, 1) > 0.5
    assert loss(td)["loss_position"].isfinite()
