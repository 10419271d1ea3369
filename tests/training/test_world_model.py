"""Training of a world model, called as in a notebook."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from small import CONSTANTS, WORLD_MODEL, make_episodes, make_model

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training import (
    WorldModelArchitecture,
    WorldModelTraining,
    build_world_model,
    train_world_model,
)
from dynmap_rl.training.world_model import choose_labelled
from dynmap_rl.utils.weights import fingerprint


def test_architecture_is_that_of_the_settings():
    default = build_world_model(CONSTANTS, WorldModelArchitecture("none"))
    assert (default.supervision, default.architecture) == ((), "glimpse")
    model = build_world_model(CONSTANTS, WorldModelTraining(supervision="position", architecture="plain"))
    assert (model.supervision, model.architecture) == (("position",), "plain")


def test_weights_change_and_metrics_are_logged(tmp_path):
    model = make_model()
    before = fingerprint(model)
    train_world_model(model, make_episodes(), tmp_path / "run", WORLD_MODEL, save_every=3)
    assert fingerprint(model) != before
    rows = read_metrics(tmp_path / "run")
    assert [row["step"] for row in rows] == [3, 6]
    assert rows[0].keys() >= {"loss_rgb", "loss_latent", "loss_position", "error_rgb", "error_position_angle"}


def test_errors_of_every_entry_on_request(tmp_path):
    train_world_model(make_model(), make_episodes(), tmp_path, WORLD_MODEL, by_entry=True)
    assert {f"error_position_{i}" for i in range(6)} < read_metrics(tmp_path)[-1].keys()


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 1},
        {"beta_z": 0.0},
        {"beta_dynamics": 0.0},
        {"rgb_frames": 1},
        {"beta_rgb": 0.5},
        {"labelled": 0.4},
        {"augmentation": Augmentation.off()},
    ],
)
def test_every_setting_has_an_effect(tmp_path, changes):
    models = make_model(), make_model()
    for model, settings in zip(models, (WORLD_MODEL, replace(WORLD_MODEL, **changes)), strict=True):
        train_world_model(
            model, make_episodes(), tmp_path / str(settings == WORLD_MODEL), replace(settings, updates=2)
        )
    assert fingerprint(models[0]) != fingerprint(models[1])


def test_dynamics_of_unlabelled_episodes_have_no_effect_and_others_have(tmp_path):
    settings, weights = replace(WORLD_MODEL, labelled=0.4), []
    for spoiled in ("none", "unlabelled", "labelled"):
        episodes, model = make_episodes(), make_model()
        if spoiled != "none":
            known = choose_labelled(episodes["train"], 0.4, settings.seed)
            other = known if spoiled == "labelled" else ~known
            episodes["train"] = episodes["train"].clone()
            position = episodes["train"]["dynamics", "position"]
            episodes["train"]["dynamics", "position"] = torch.where(other, 5.0, position)
        train_world_model(model, episodes, tmp_path / spoiled, settings)
        weights.append(fingerprint(model))
    assert weights[0] == weights[1] != weights[2]


def test_entries_that_were_not_found_have_no_effect(tmp_path):
    weights = []
    for value in (0.0, 5.0):
        episodes, model = make_episodes(), make_model()
        train = episodes["train"] = episodes["train"].clone()
        found = torch.ones_like(train["dynamics", "position"], dtype=torch.bool)
        found[..., 3:] = False
        train["labelled"] = found
        train["dynamics", "position"][..., 3:] = value
        train_world_model(model, episodes, tmp_path / str(value), replace(WORLD_MODEL, labelled=0.6))
        weights.append(fingerprint(model))
    assert weights[0] == weights[1]


def test_labelled_episodes_are_whole_seeded_and_nested():
    episodes = make_episodes(20)["train"]
    draws = [choose_labelled(episodes, share, 3) for share in (0.01, 0.25, 0.5, 1.0)]
    assert [int(draw[:, 0].sum()) for draw in draws] == [1, 5, 10, 20]
    assert all((draw == draw[:, :1]).all() for draw in draws)
    assert all((large | ~small).all() for small, large in pairwise(draws))
    assert not torch.equal(draws[1], choose_labelled(episodes, 0.25, 4))
    pieces = torch.cat([episodes, episodes]).set(
        "episode", torch.arange(20).repeat(2)[:, None].expand(40, 12)
    )
    draw = choose_labelled(pieces, 0.25, 3)
    assert torch.equal(draw[:20], draw[20:]) and int(draw[:20, 0].sum()) == 5


def test_without_the_rgb_loss_the_decoder_of_frames_is_not_trained(tmp_path):
    model = make_model()
    before = [p.clone() for p in model.image_decoder.parameters()]
    settings = replace(WORLD_MODEL, beta_rgb=0.0, rgb_frames=WorldModelTraining.rgb_frames)
    train_world_model(model, make_episodes(), tmp_path, settings)
    assert all(torch.equal(a, b) for a, b in zip(before, model.image_decoder.parameters(), strict=True))
    assert "loss_rgb" not in read_metrics(tmp_path)[-1] and "loss_position" in read_metrics(tmp_path)[-1]
