"""Policies for other tasks on a frozen world model of task 1, as commands."""

import shutil

import pytest
from commands import PRESETS, place_recordings, run, run_small
from safetensors.torch import load_file, save_file
from small import CONSTANTS

from dynmap_rl.modules.checkpoints import make_world_model, save_world_model
from dynmap_rl.runs.lookup import SHIPPED
from dynmap_rl.utils.files import read_json, write_json

WEIGHTS = "world_model/weights.safetensors"
TASK = "bin_dropping"


@pytest.fixture(scope="module")
def small(tmp_path_factory, recordings):
    """Return a folder with a finished run on a copy of the shipped world model, and the command's result."""
    folder = tmp_path_factory.mktemp("generalize")
    place_recordings(folder, recordings, "balance_reaching", TASK)
    shutil.copytree(SHIPPED / "balance_reaching", folder / "runs/source")
    six = {"low": [-1.0] * 6, "high": [1.0] * 6}
    save_world_model(folder / "runs/robot/world_model", make_world_model(CONSTANTS | {"action": six}, ()))
    source = {"training": "decoupled", "dataset": "robot"}
    write_json(folder / "runs/robot/eval.json", {"world_model": source})
    return folder, run_small(folder, "generalize", "--task", TASK, "--pretrained", "runs/source")


def test_the_world_model_is_that_of_task_1(small):
    folder, result = small
    [run_folder] = (folder / "runs/generalize" / TASK).iterdir()
    evaluation = read_json(run_folder / "eval.json")
    assert evaluation["task"] == TASK
    assert evaluation["world_model"] == {"task": "balance_reaching", "training": "decoupled"}
    source = folder / "runs/source" / WEIGHTS
    ours, theirs = load_file(run_folder / WEIGHTS), load_file(source)
    assert ours.keys() == theirs.keys() and all(ours[name].equal(theirs[name]) for name in ours)
    assert "53 (3.4)" in result.stdout, "the paper's success rate"
    assert "DR" not in result.stdout, "the paper reports the success rate alone"


def test_the_same_command_prints_the_result_again(small):
    folder, _ = small
    again = run_small(folder, "generalize", "--task", TASK, "--pretrained", "runs/source")
    assert "complete" in again.stdout


def test_another_world_model_in_its_place_is_refused(small, tmp_path):
    folder, _ = small
    shutil.copytree(folder / "runs", tmp_path / "runs")
    weights = tmp_path / "runs/source" / WEIGHTS
    state = load_file(weights)
    next(iter(state.values())).view(-1)[0] += 1e-3
    save_file(state, weights)
    arguments = "--config_path", PRESETS / "generalize.yaml", "--task", TASK, "--pretrained", "runs/source"
    result = run(tmp_path, "generalize", *arguments)
    assert result.returncode == 2 and "another world model" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "balance_reaching"], "balance_reaching for both"),
        (["--task", "juggling"], "juggling"),
        (["--task", TASK, "--pretrained", "runs/robot"], "with the actions of bin_dropping, got runs/robot"),
        (["--task", TASK, "--pretrained", "nowhere"], "nowhere holds no finished run"),
        (["--task", TASK, "--dataset", "datasets/balance_reaching"], "must be a dataset of bin_dropping"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(small, arguments, message):
    folder, _ = small
    result = run(folder, "generalize", "--run", "runs/bad", "--pretrained", "runs/source", *arguments)
    assert result.returncode == 2 and message in result.stderr
    assert not (folder / "runs/bad").exists()
