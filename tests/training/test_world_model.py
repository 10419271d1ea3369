"""Training of a world model, called as in a notebook."""

from dataclasses import replace

import pytest
from small import CONSTANTS, WORLD_MODEL, make_episodes, make_model

from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training import (
    WorldModelArchitecture,
    WorldModelTraining,
    build_world_model,
    train_world_model,
)
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


@pytest.mark.parametrize("changes", [{"seed": 1}, {"beta_z": 0.0}, {"beta_dynamics": 0.0}, {"rgb_frames": 1}])
def test_every_setting_has_an_effect(tmp_path, changes):
    models = make_model(), make_model()
    for model, settings in zip(models, (WORLD_MODEL, replace(WORLD_MODEL, **changes)), strict=True):
        train_world_model(
            model, make_episodes(), tmp_path / str(settings == WORLD_MODEL), replace(settings, updates=2)
        )
    assert fingerprint(models[0]) != fingerprint(models[1])
