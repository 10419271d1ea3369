import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.runs import read_json

ROOT = Path(__file__).parents[2]


def run(folder, recipe, *arguments):
    command = [sys.executable, str(ROOT / "recipes" / f"{recipe}.py"), *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """A smoke run of task 1, and its world model taken to task 3."""
    folder = tmp_path_factory.mktemp("smoke")
    source = run(folder, "decoupled", "--smoke", "--supervision", "none")
    assert source.returncode == 0, source.stderr
    trained = "runs/decoupled/balance_reaching/none_recurrent_smoke"
    result = run(folder, "generalize", "--smoke", "--task", "bin_dropping", "--world_model", trained)
    assert result.returncode == 0, result.stderr
    return folder, trained, result


def test_the_world_model_is_that_of_task_1(smoke):
    folder, trained, _ = smoke
    run_folder = folder / "runs/generalize/bin_dropping/none_recurrent_smoke"
    evaluation = read_json(run_folder / "eval.json")
    assert evaluation["task"] == "bin_dropping"
    assert evaluation["world_model"] == {"task": "balance_reaching", "training": "decoupled"}
    assert evaluation["world_model_sha256"] == read_json(folder / trained / "eval.json")["world_model_sha256"]
    weights = "world_model/weights.safetensors"
    assert (run_folder / weights).read_bytes() == (folder / trained / weights).read_bytes()
    assert (
        json.loads((folder / "datasets/bin_dropping_smoke/meta/dynmap.json").read_text())["task"]
        == "bin_dropping"
    )


def test_the_row_stands_beside_the_papers_table_3(smoke):
    _, _, result = smoke
    assert "Only-RGB of balance_reaching, recurrent policy, bin_dropping" in result.stdout
    assert "SR 44 (0.0) %" in result.stdout
    assert "DR" not in result.stdout, "the paper reports the success rate alone"


def test_the_same_command_again_says_that_it_is_done(smoke):
    folder, trained, _ = smoke
    again = run(folder, "generalize", "--smoke", "--task", "bin_dropping", "--world_model", trained)
    assert again.returncode == 0
    assert "is done" in again.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "balance_reaching"], "was trained on balance_reaching itself"),
        (["--task", "juggling"], "unknown task"),
        (
            ["--world_model", "nowhere"],
            "holds no finished run; train a world model with recipes/decoupled.py",
        ),
        (
            ["--task", "bin_dropping", "--dataset", "datasets/balance_reaching_smoke"],
            "holds the task balance_reaching",
        ),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(smoke, arguments, message):
    folder, trained, _ = smoke
    if "--world_model" not in arguments:
        arguments = ["--world_model", trained, *arguments]
    result = run(folder, "generalize", "--smoke", "--run", "runs/bad", *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not (folder / "runs/bad").exists()
