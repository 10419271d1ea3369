"""Errors on held-out episodes, against numbers by hand."""

import math

import pytest
import torch
from small import CONSTANTS, load, make_episodes, make_model

from dynmap_rl.data.features import compute_features
from dynmap_rl.evaluation.errors import judge_held_out, policy_errors, prediction_errors
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.objectives.imitation import ImitationLoss


@pytest.fixture(scope="module")
def episodes():
    return make_episodes()["eval"]


def make_small_policy(model):
    torch.manual_seed(1)
    return make_policy(CONSTANTS, "recurrent", model, width=8).eval()


def test_prediction_errors_are_means_over_steps_with_a_prediction(episodes):
    model = make_model().eval()
    with torch.no_grad():
        states = model.predict(model.encode(episodes["pixels"], mixed=True), episodes["action"])
        difference = model.decode_dynamics(*states)["position"] - episodes["dynamics", "position"]
    error = difference[:, 1:].abs().mean((0, 1))
    found = prediction_errors(model, episodes)
    assert set(found) == {"error_rgb", "error_position", "error_position_angle"}
    assert found["error_position"] == pytest.approx(error[[0, 1, 3, 4]].mean().item())
    assert found["error_position_angle"] == pytest.approx(error[[2, 5]].mean().item())
    by_entry = prediction_errors(model, episodes, batch=2, by_entry=True)
    entries = [by_entry[f"error_position_{i}"] for i in range(6)]
    torch.testing.assert_close(torch.tensor(entries), error, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("size", [2, 4])
def test_points_have_no_angle(episodes, size):
    constants = CONSTANTS | {"position": {"low": [0.0] * size, "high": [1.0] * size}}
    model = make_world_model(constants, ("position",), latent_size=16, hidden_size=24).eval()
    points = episodes.clone()
    points["dynamics", "position"] = episodes["dynamics", "position"][..., :size]
    found, by_entry = (prediction_errors(model, points, by_entry=by_entry) for by_entry in (False, True))
    assert set(found) == {"error_rgb", "error_position"}
    entries = [by_entry[f"error_position_{i}"] for i in range(size)]
    assert found["error_position"] == pytest.approx(sum(entries) / size, rel=1e-5)


def test_dynamics_that_were_not_found_are_left_out(episodes):
    model, episodes = make_model().eval(), episodes.clone()
    known = torch.ones_like(episodes["dynamics", "position"], dtype=torch.bool)
    known[0, 3:5, 0], known[..., 5] = False, False
    with torch.no_grad():
        states = model.predict(model.encode(episodes["pixels"], mixed=True), episodes["action"])
        error = (model.decode_dynamics(*states)["position"] - episodes["dynamics", "position"])[:, 1:].abs()
    episodes["labelled"] = known
    episodes["dynamics", "position"][~known] = 1e6
    found = prediction_errors(model, episodes, batch=1, by_entry=True)
    steps = episodes.clone().set("labelled", known[..., 1])  # one flag for all entries
    assert prediction_errors(model, steps)["error_position"] > 1e3
    assert found["error_position_0"] == pytest.approx(error[..., 0][known[:, 1:, 0]].mean().item(), rel=1e-3)
    assert found["error_position_1"] == pytest.approx(error[..., 1].mean().item(), rel=1e-3)
    assert math.isnan(found["error_position_5"]), "never found"
    with torch.no_grad():
        next(model.dynamics_decoder.parameters()).fill_(torch.nan)
    assert math.isnan(prediction_errors(model, episodes, by_entry=True)["error_position_1"]), (
        "a wrong prediction counts"
    )


@torch.no_grad()
def test_rgb_errors_are_means_of_those_of_single_frames(episodes):
    model, episodes = make_model().eval(), episodes.clone()
    episodes["pixels"][0] = 255  # frames whose errors are unlike
    states = model.predict(model.encode(episodes["pixels"], mixed=True), episodes["action"])
    error = (model.decode_pixels(*states) - episodes["pixels"] / 255)[:, [1, 11]]
    expected = error.square().mean((-3, -2, -1)).sqrt().mean().item()
    assert prediction_errors(model, episodes)["error_rgb"] == pytest.approx(expected, rel=1e-4)


def test_policy_errors_leave_disturbed_steps_out_of_the_loss(episodes):
    model = make_model().eval()
    policy = make_small_policy(model)
    features = compute_features(model, episodes)
    found = policy_errors(policy, features)
    assert found["imitation_l1"] == pytest.approx(ImitationLoss(policy)(features)["loss_policy"].item())
    with torch.no_grad():
        predicted = policy(*(features[key] for key in ("latent", "hidden1", "hidden2", "goal")))
    error = (predicted - features["action"]).abs()
    assert found["error_action_2"] == pytest.approx(error[..., 2].mean().item())
    features["disturbed"][:, 0] = True
    rest = policy_errors(policy, features)["imitation_l1"]
    assert policy_errors(policy, features)["error_action_2"] == pytest.approx(error[:, 1:, 2].mean().item())
    assert rest == pytest.approx((error / 0.02)[:, 1:].mul(torch.tensor([1, 1, 0.4])).mean().item(), rel=1e-4)


def test_held_out_errors_are_those_of_both_parts(episodes):
    model = make_model().eval()
    policy = make_small_policy(model)
    expected = prediction_errors(model, episodes, by_entry=True)
    expected |= policy_errors(policy, compute_features(model, episodes))
    assert judge_held_out(model, policy, load) == {"held_out": expected}
