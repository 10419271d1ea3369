"""Policies on a frozen world model: nothing finished is repeated, and the world model stays as it is."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file
from small import CONSTANTS, POLICY, Stop, judge, make_episodes, make_model, read_weights

from dynmap_rl.training import PolicyTraining, decoupled, train_policies
from dynmap_rl.utils.devices import Compute
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.weights import fingerprint


def train(folder, model=None, judge=judge, seeds=(0,), threads=1, settings=POLICY, **more):
    common = {"judge": judge, "seeds": seeds, "compute": Compute("cpu", threads)}
    return train_policies(
        model or make_model(), make_episodes(), CONSTANTS, folder, settings, **common, **more
    )


def stop(*args, **kwargs):
    raise Stop


@pytest.mark.slow
def test_two_processes_give_the_same_weights_as_one(tmp_path):
    prints = [train(tmp_path / str(n), seeds=(0, 1), threads=n) for n in (1, 2)]
    assert prints[0] == prints[1] == fingerprint(make_model())
    one, two = (read_weights(tmp_path / str(n)) for n in (1, 2))
    assert one == two
    assert one["seed_0/policy/weights.safetensors"] != one["seed_1/policy/weights.safetensors"]
    assert not (tmp_path / "1/features").exists()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_frozen_world_model_that_changes_stops_the_run(tmp_path, monkeypatch, seed):
    """One weight on the disk changes after the policy of a seed is finished: of the first, or of the last."""
    weights = tmp_path / "world_model/weights.safetensors"

    def work_and_tamper(stages, arguments, count):
        for number, one in enumerate(arguments):
            for stage in stages:
                stage(one)
            if number == seed:
                state = load_file(weights)
                next(iter(state.values())).view(-1)[0] += 1e-6
                save_file(state, weights)

    monkeypatch.setattr(decoupled, "run_processes", work_and_tamper)
    with pytest.raises(ValueError, match="world model .*has changed"):
        train(tmp_path, seeds=(0, 1))
    assert (tmp_path / "seed_0/eval.json").exists()
    assert (tmp_path / "seed_1/eval.json").exists() is (seed == 1)


def test_a_trained_policy_is_judged_without_training_it_again(tmp_path, monkeypatch):
    with pytest.raises(Stop):
        train(tmp_path, judge=stop)
    monkeypatch.setattr(decoupled, "train_policy", stop)
    print_of_frozen = train(tmp_path)
    assert read_json(tmp_path / "seed_0/eval.json")["world_model_sha256"] == print_of_frozen
    (tmp_path / "seed_0/eval.json").unlink()
    other = make_model()
    with torch.no_grad():
        next(other.parameters()).add_(1e-3)
    with pytest.raises(Stop):
        train(tmp_path, other)


def test_a_finished_seed_is_left_alone(tmp_path, monkeypatch):
    train(tmp_path)
    monkeypatch.setattr(decoupled, "compute_features", stop)
    train(tmp_path, judge=stop)
    with pytest.raises(ValueError, match="other settings"):
        train(tmp_path, settings=replace(POLICY, kind="feedforward"))


def test_another_world_model_beside_a_finished_seed_is_refused_and_overwrites_nothing(tmp_path):
    """The finished policy belongs to the one that is there."""
    train(tmp_path)
    other, before = make_model(), read_weights(tmp_path)
    with torch.no_grad():
        next(other.parameters()).add_(1e-3)
    with pytest.raises(ValueError, match="another world model"):
        train(tmp_path, other, seeds=(0, 1))
    assert read_weights(tmp_path) == before


def test_a_policy_that_is_older_than_a_setting_has_its_default(tmp_path):
    train(tmp_path)
    stored = read_json(tmp_path / "seed_0/trained.json")
    del stored["settings"]["corrections"]
    write_json(tmp_path / "seed_0/trained.json", stored)
    train(tmp_path, judge=stop)
    with pytest.raises(ValueError, match="other settings"):
        train(tmp_path, settings=replace(POLICY, corrections=1), task="balance_reaching")


def test_a_policy_sees_the_states_of_augmented_copies(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        decoupled, "train_policy", lambda policy, features, *_, **__: seen.append(features.clone())
    )
    for task in ("balance_reaching", "bin_dropping"):
        train(tmp_path / task, settings=replace(POLICY, copies=2), task=task)
    symmetric, other = seen
    assert len(symmetric) == len(other) == 3 * len(make_episodes()["train"])
    original, first, second = symmetric.split(3)
    for key in ("latent", "action", "goal"):
        assert torch.equal(other[key][:3], original[key])
        assert not torch.equal(first[key], original[key]) and not torch.equal(first[key], second[key])
    assert torch.equal(other["goal"][3:6], original["goal"]), "scenes of task 3 cannot be mirrored or shifted"
    assert not torch.equal(other["latent"][3:6], original["latent"]), "but be recoloured"


@pytest.mark.parametrize("task", [None, "mujoco:FetchPush"])
def test_copies_need_a_task_in_the_plane(task):
    if task:
        pytest.importorskip("mujoco")
    with pytest.raises(ValueError, match="copies need a task in the plane"):
        decoupled.check_copies(PolicyTraining(copies=1), task)


def test_states_that_do_not_fit_on_the_disk_are_not_written(tmp_path, monkeypatch):
    """Writing to a mapped file on a full disk would kill the process without a message."""
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=10))
    with pytest.raises(OSError, match="MB are needed"):
        train(tmp_path)
    assert not (tmp_path / "features").exists()
