"""Training of a policy on the states of a frozen world model."""

import pytest
import torch
from small import CONSTANTS, POLICY, make_episodes, make_model

from dynmap_rl.data.features import compute_features
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.objectives.imitation import ImitationLoss
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training import policy as policy_training
from dynmap_rl.training import train_policy
from dynmap_rl.training.loop import check_loss
from dynmap_rl.utils.weights import fingerprint


@pytest.fixture
def model():
    return make_model().eval().requires_grad_(False)


@pytest.fixture
def features(model):
    return compute_features(model, make_episodes()["train"])


@pytest.mark.parametrize("kind", ["recurrent", "feedforward"])
def test_the_policy_learns_and_the_world_model_stays(tmp_path, model, features, kind):
    before, policy = fingerprint(model), make_policy(CONSTANTS, kind, model, width=16)
    untrained = fingerprint(policy)
    train_policy(policy, features, features, tmp_path / "new", POLICY, seed=3)
    assert fingerprint(model) == before
    assert fingerprint(policy) != untrained
    [row] = read_metrics(tmp_path / "new")
    assert row["step"] == POLICY.updates and row.keys() == {"step", "loss", "held_out_loss"}
    with torch.no_grad():
        plain = ImitationLoss(policy)(features)["loss_policy"].item()  # without the emphasis of the training
    assert row["held_out_loss"] == pytest.approx(plain, rel=0.02)


def test_a_loss_that_is_not_finite_stops_the_training(tmp_path, model, features):
    features["action"][:] = float("nan")
    with pytest.raises(ValueError, match="not finite"):
        train_policy(make_policy(CONSTANTS, "recurrent", model), features, features, tmp_path, POLICY)
    assert read_metrics(tmp_path) == []


def test_a_policy_that_goes_on_is_not_held_to_its_own_low_loss(tmp_path, model, features, monkeypatch):
    """With the states of corrections its loss may rise at once, by any factor."""
    losses = iter([1.0, 0.1, 0.001, 5.0])  # at the first and the last update of two trainings

    def check(_, norm, first=None):
        return check_loss(next(losses), norm, first)

    monkeypatch.setattr(policy_training, "check_loss", check)
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    for done in (0, POLICY.updates):
        train_policy(policy, features, features, tmp_path, POLICY, done=done)
    assert [row["step"] for row in read_metrics(tmp_path)] == [POLICY.updates, 2 * POLICY.updates]
