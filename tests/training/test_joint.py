"""Joint and end-to-end training: what learns, and that threads and kills change no weight."""

from dataclasses import replace

import pytest
import torch
from small import CONSTANTS, END_TO_END, JOINT, Stop, judge, load, make_episodes, make_model, read_weights

from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training import PolicyArchitecture, WorldModelArchitecture, loop, train_seeds
from dynmap_rl.training import joint as module
from dynmap_rl.training.joint import train_end_to_end, train_jointly
from dynmap_rl.utils.devices import Compute
from dynmap_rl.utils.weights import fingerprint

FORM = WorldModelArchitecture("position"), PolicyArchitecture("feedforward")


def train(folder, settings=JOINT, seeds=(0,), threads=1):
    compute = Compute("cpu", threads)
    return train_seeds(load, folder, *FORM, settings, judge=judge, seeds=seeds, compute=compute)


@pytest.mark.parametrize(("function", "settings"), [(train_jointly, JOINT), (train_end_to_end, END_TO_END)])
def test_world_model_and_policy_learn(tmp_path, function, settings):
    model = make_model()
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    parts = model.encoder, model.transition, model.image_decoder, model.dynamics_decoder, policy
    before = [fingerprint(part) for part in parts]
    function(model, policy, make_episodes(), tmp_path, settings)
    changed = [fingerprint(part) != old for part, old in zip(parts, before, strict=True)]
    jointly = function is train_jointly
    assert changed == [True, True, jointly, jointly, True], "end to end, no decoder is trained"
    row = read_metrics(tmp_path)[-1]
    assert ("loss_rgb" in row, "held_out_loss" in row) == (jointly, True)


@pytest.mark.slow
def test_two_processes_give_the_same_weights_as_one(tmp_path):
    firsts = [train(tmp_path / str(n), seeds=(0, 1), threads=n) for n in (1, 2)]
    one, two = (read_weights(tmp_path / str(n)) for n in (1, 2))
    assert one == two and fingerprint(firsts[0]) == fingerprint(firsts[1])
    name = "world_model/weights.safetensors"
    assert one[name] == one[f"seed_0/{name}"] != one[f"seed_1/{name}"], (
        "every seed has a world model of its own"
    )


def test_a_killed_run_resumes_to_the_same_weights(tmp_path, monkeypatch):
    train(tmp_path / "whole")

    def stop(*args):
        raise Stop

    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(module, "save_world_model", stop)
        train(tmp_path / "killed")
    torch.manual_seed(5)
    train(tmp_path / "killed")
    assert read_weights(tmp_path / "killed") == read_weights(tmp_path / "whole")


@pytest.mark.parametrize(("function", "settings"), [(train_jointly, JOINT), (train_end_to_end, END_TO_END)])
def test_a_run_that_is_killed_among_short_windows_resumes_to_the_same_weights(
    tmp_path, monkeypatch, function, settings
):
    sample, save, sizes = loop.sample_windows, loop.save_training_state, []

    def sample_and_note(episodes, *size):
        sizes.append(size[:2])
        return sample(episodes, *size)

    def save_then_stop(path, **state):
        save(path, **state)
        raise Stop

    def train_again(folder):
        model = make_model()
        policy = make_policy(CONSTANTS, "recurrent", model, width=16)
        function(model, policy, make_episodes(), folder, settings, save_every=2)
        return fingerprint(model), fingerprint(policy)

    monkeypatch.setattr(loop, "sample_windows", sample_and_note)
    whole = train_again(tmp_path / "whole")
    assert [steps for _, steps in sizes] == [4, 4, 4, 5, 5, 5]
    with monkeypatch.context() as patch, pytest.raises(Stop):
        patch.setattr(loop, "save_training_state", save_then_stop)
        train_again(tmp_path / "killed")
    assert train_again(tmp_path / "killed") == whole
    assert [steps for _, steps in sizes[6:]] == [4, 4, 4, 5, 5, 5], "updates that were saved are not repeated"


def test_a_finished_seed_is_left_alone(tmp_path, monkeypatch):
    train(tmp_path)
    weights = read_weights(tmp_path)
    monkeypatch.setattr(module, "fit", None)
    train(tmp_path)
    assert read_weights(tmp_path) == weights


def test_a_seed_of_other_settings_is_refused(tmp_path):
    train(tmp_path)
    for settings in (replace(JOINT, beta_z=0.9), END_TO_END):
        with pytest.raises(ValueError, match="seed_0 was trained with other settings"):
            train(tmp_path, settings)
