"""PPO: it resumes to the same weights, on any number of threads, and stops where the loss is not finite."""

import math
import os
from dataclasses import replace
from functools import partial

import pytest
import torch
from safetensors.torch import load_file
from small import Stop, exit_elsewhere

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.experts.network import ExpertNetwork, list_checkpoints
from dynmap_rl.runs.folder import load_training_state, read_metrics, save_training_state
from dynmap_rl.training import PPOTraining, ppo, train_ppo
from dynmap_rl.utils.devices import seed_everything
from dynmap_rl.utils.files import read_json

SIZES = {"num_envs": 3, "iterations": 2, "epochs": 1, "minibatch": 120, "checkpoint_every": 1}
SETTINGS = PPOTraining(**SIZES, eval_episodes=3, final_episodes=4)
WEIGHTS = "checkpoint/iteration_002.safetensors"


@pytest.fixture(scope="module", autouse=True)
def small_groups():
    """Divide three worlds into two groups, for two processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "GROUP", 2)
        yield


MAKE_ENV = partial(DynmapBatchedEnv, "balance_reaching", control="acceleration")


def train(folder, settings=SETTINGS, threads=1, make_env=MAKE_ENV, width=16):
    seed_everything(settings.seed)
    network = ExpertNetwork(get_task("balance_reaching").state_size, tuple(ACCELERATION_LIMIT), width)

    def judge(episodes):
        return {"episodes": episodes, "success": 0.0, "drop": 0.0}

    train_ppo(make_env, network, folder, settings, judge=judge, facts={"task": "mine"}, threads=threads)


def metrics(folder):
    """Return all metrics but the wall-clock time."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in read_metrics(folder)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ppo")
    train(folder)
    return folder


def test_checkpoints_and_metrics(finished):
    assert [(row["step"], row["frames"]) for row in metrics(finished)] == [
        (1, 3 * SETTINGS.steps),
        (2, 6 * SETTINGS.steps),
    ]
    facts = [read_json(finished / f"checkpoint/iteration_00{i}.json") for i in (1, 2)]
    assert [(f["iteration"], f["episodes"], f["task"]) for f in facts] == [(1, 3, "mine"), (2, 4, "mine")]
    first, last = (load_file(finished / f"checkpoint/iteration_00{i}.safetensors") for i in (1, 2))
    assert any(not torch.equal(first[k], last[k]) for k in first)


def test_a_checkpoint_is_listed_only_with_its_facts(tmp_path, monkeypatch):
    """A kill between its two files leaves none."""

    def die(*_):
        raise Stop

    monkeypatch.setattr(ppo, "write_json", die)
    with pytest.raises(Stop):
        train(tmp_path)
    with pytest.raises(ValueError, match="no expert"):
        list_checkpoints(tmp_path / "checkpoint")


def test_a_rollout_may_go_on_after_the_time_limit(tmp_path):
    train(tmp_path, replace(SETTINGS, steps=130, iterations=1))
    assert math.isfinite(metrics(tmp_path)[0]["loss_critic"])


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize("iteration", [1, 2])
def test_a_killed_training_resumes_to_the_same_weights(finished, tmp_path, monkeypatch, saved, iteration):
    def kill(path, **state):
        if saved or state["iteration"] < iteration:
            save_training_state(path, **state)
        if state["iteration"] == iteration:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(ppo, "save_training_state", kill)
        train(tmp_path)
    train(tmp_path)
    assert metrics(tmp_path) == metrics(finished)
    assert (tmp_path / WEIGHTS).read_bytes() == (finished / WEIGHTS).read_bytes()


def test_the_number_of_processes_changes_no_weight(finished, tmp_path):
    train(tmp_path, threads=2)
    assert metrics(tmp_path) == metrics(finished)
    assert (tmp_path / WEIGHTS).read_bytes() == (finished / WEIGHTS).read_bytes()


def test_a_state_of_an_earlier_release_is_refused(tmp_path):
    save_training_state(tmp_path / "checkpoint/training_state.pt", loss_module={}, iteration=1)
    with pytest.raises(ValueError, match=r"training_state\.pt .*--run"):
        train(tmp_path)


def test_a_state_of_other_settings_is_refused(tmp_path):
    small = replace(SETTINGS, iterations=1)
    train(tmp_path, small)
    with pytest.raises(ValueError, match="other settings; choose another --run"):
        train(tmp_path, replace(small, iterations=2, gamma=0.5))
    with pytest.raises(ValueError, match="network of another size; choose another --run"):
        train(tmp_path, replace(small, iterations=2), width=8)


def test_a_loss_that_is_not_finite_keeps_the_last_state(tmp_path, monkeypatch):
    whole, calls = ppo.update, []

    def break_the_second(batch, *rest):
        calls.append(1)
        if len(calls) == 2:
            batch["next", "reward"][0] = float("nan")
        return whole(batch, *rest)

    monkeypatch.setattr(ppo, "update", break_the_second)
    with pytest.raises(ValueError, match="not finite"):
        train(tmp_path)
    assert load_training_state(tmp_path / "checkpoint/training_state.pt")["iteration"] == 1
    weights = load_file(tmp_path / "checkpoint/iteration_001.safetensors")
    assert all(value.isfinite().all() for value in weights.values())
    assert [row["step"] for row in metrics(tmp_path)] == [1]


def test_a_process_that_dies_is_an_error_and_the_training_resumes(finished, tmp_path):
    with pytest.raises(OSError, match="a process died"):
        train(tmp_path, threads=2, make_env=partial(exit_elsewhere, own=os.getpid()))
    train(tmp_path)
    assert (tmp_path / WEIGHTS).read_bytes() == (finished / WEIGHTS).read_bytes()
