"""Checkpoints are complete, and a file's arguments are checked before memory is taken."""

import json

import pytest
import torch
from small import CONSTANTS, make_model

from dynmap_rl.modules import checkpoints
from dynmap_rl.modules.checkpoints import (
    load_policy,
    load_world_model,
    make_policy,
    make_world_model,
    save_policy,
    save_world_model,
)
from dynmap_rl.modules.policy import FeedforwardPolicy
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.weights import fingerprint


@pytest.mark.parametrize(("kind", "architecture"), [("recurrent", "glimpse"), ("feedforward", "plain")])
def test_checkpoints_are_complete(tmp_path, kind, architecture):
    model = make_world_model(CONSTANTS, ("position",), 16, 24, architecture)
    policy = make_policy(CONSTANTS, kind, model, width=20)
    save_world_model(tmp_path / "model", model)
    save_policy(tmp_path / "policy", policy, model)
    loaded = load_world_model(tmp_path / "model"), load_policy(tmp_path / "policy")
    for before, after in zip((model, policy), loaded, strict=True):
        assert type(before) is type(after) and not after.training
        assert fingerprint(before) == fingerprint(after)


def test_constants_that_are_missing_are_named():
    with pytest.raises(ValueError, match="constants must have position, got action"):
        make_world_model({"action": CONSTANTS["action"]}, ("position",))


def test_a_class_that_could_not_be_loaded_is_not_saved(tmp_path):
    class Policy(FeedforwardPolicy):
        pass

    class Model(WorldModel):
        pass

    model = make_model()
    policy = make_policy(CONSTANTS, "feedforward", model)
    model.__class__, policy.__class__ = Model, Policy
    with pytest.raises(TypeError, match="got Policy"):
        save_policy(tmp_path, policy, model)
    with pytest.raises(TypeError, match="got Model"):
        save_world_model(tmp_path, model)
    assert not any(tmp_path.iterdir())


def test_a_world_model_of_the_first_release_is_plain_or_refused(tmp_path):
    model = make_world_model(CONSTANTS, ("position",), 16, 24, "plain")
    save_world_model(tmp_path, model)
    path = tmp_path / "arguments.json"
    arguments = json.loads(path.read_text())
    del arguments["architecture"]
    path.write_text(json.dumps(arguments | {"keypoints": False}))
    assert fingerprint(load_world_model(tmp_path)) == fingerprint(model)
    path.write_text(json.dumps(arguments | {"keypoints": True}))
    with pytest.raises(ValueError, match="train it again"):
        load_world_model(tmp_path)


@pytest.fixture
def saved(tmp_path):
    """Return a function that saves a small model under changed arguments, and returns its folder."""
    model = make_model()
    save_world_model(tmp_path / "world_model", model)
    save_policy(tmp_path / "policy", make_policy(CONSTANTS, "recurrent", model, width=20), model)

    def change(name, **arguments):
        path = tmp_path / name / "arguments.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | arguments))
        return path.parent

    return change


@pytest.mark.parametrize(
    "arguments",
    [
        {"hidden_size": 500},
        {"hidden_size": 10**6},
        {"hidden_size": 10**18},
        {"latent_size": -1},
        {"latent_size": "16"},
        {"action": 10**12},
        {"dynamics": {"position": 10**12}},
        {"dynamics": ["position"]},
        {"dynamics": {"../../out": 6}},
        {"unknown": 1},
    ],
)
def test_wrong_arguments_are_refused_before_memory_is_taken(saved, monkeypatch, arguments):
    """Only a module on the meta device, without memory, is made."""
    made = []

    def make(**arguments):
        made.append(torch.empty(0).device.type)
        return WorldModel(**arguments)

    monkeypatch.setattr(checkpoints, "WorldModel", make)
    load_world_model(saved("world_model"))
    assert made == ["meta", "cpu"]
    made.clear()
    with pytest.raises(ValueError, match=r"weights\.safetensors"):
        load_world_model(saved("world_model", **arguments))
    assert made in ([], ["meta"])


@pytest.mark.parametrize("cameras", [0, 10**9, "2", None, [1]])
def test_a_wrong_number_of_cameras_is_refused(saved, cameras):
    with pytest.raises(ValueError, match="cameras, got"):
        load_world_model(saved("world_model", cameras=cameras))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 10**9}, r"weights\.safetensors"),
        ({"goal": None}, r"weights\.safetensors"),
        ({"kind": "os.system"}, r"os\.system"),
        ({"kind": ["recurrent"]}, r"\['recurrent'\]"),
    ],
)
def test_a_policys_arguments_are_checked_too(saved, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_policy(saved("policy", **arguments))


def test_other_folders_are_named(saved, tmp_path):
    with pytest.raises(ValueError, match=r"arguments\.json"):
        load_world_model(tmp_path)
    with pytest.raises(ValueError, match="world_model"):
        load_policy(saved("world_model"))
    with pytest.raises(ValueError, match="policy"):
        load_world_model(saved("policy"))
    (saved("world_model") / "arguments.json").write_text('["dynamics"]')
    with pytest.raises(ValueError, match=r"arguments\.json"):
        load_world_model(tmp_path / "world_model")


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match="transformer"):
        make_policy(CONSTANTS, "transformer", make_model())
    for supervision in (("jerk",), "position"):
        with pytest.raises(ValueError, match="supervision must be a sequence"):
            make_world_model(CONSTANTS, supervision)
