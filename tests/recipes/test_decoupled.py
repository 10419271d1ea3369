import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def run(folder, *arguments):
    command = [sys.executable, str(ROOT / "recipes" / "decoupled.py"), *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """One smoke run with no other option: it records, trains, evaluates and draws."""
    folder = tmp_path_factory.mktemp("smoke")
    result = run(folder, "--smoke")
    assert result.returncode == 0, result.stderr
    return folder, result


def test_smoke_run_leaves_everything_behind(smoke):
    folder, result = smoke
    run_folder = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke"
    assert "RGB+[P+V], recurrent policy" in result.stdout
    assert "DR 5 (2.5) %   PE 23 (3.7) mm   SR 89 (0.9) %" in result.stdout  # the paper's row
    evaluation = json.loads((run_folder / "eval.json").read_text())
    assert evaluation["row"] == "RGB+[P+V]"
    assert evaluation["trained_on"]["episodes"] == 4
    assert evaluation["test_protocol"]["episodes"] == 2 * 3
    assert len(evaluation["results"]) == 2
    assert len(evaluation["results"][0]["test"]["rows"]["success"]) == 3
    for name in ("figures/reconstruction.png", "figures/dynamics.png", "rollouts.gif"):
        assert (run_folder / name).stat().st_size > 1000
    assert not (run_folder / "features").exists()


def test_the_same_command_again_says_that_it_is_done(smoke):
    folder, first = smoke
    again = run(folder, "--smoke")
    assert "is done" in again.stdout
    assert first.stdout.split("\n")[1] in again.stdout


def test_another_row_uses_the_same_dataset_and_the_trained_world_model(smoke):
    folder, _ = smoke
    trained = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke/world_model"
    result = run(folder, "--smoke", "--policy", "feedforward", "--seeds", "0", "--world_model", str(trained))
    assert result.returncode == 0, result.stderr
    assert "recording" not in result.stderr
    other = folder / "runs/decoupled/balance_reaching/position_velocity_feedforward_smoke"
    assert (other / "world_model/weights.safetensors").read_bytes() == (
        trained / "weights.safetensors"
    ).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--supervision", "jerk"], "unknown supervision"),
        (["--policy", "transformer"], "unknown policy"),
        (["--dataset", "no/where/here"], "no dataset at no/where/here"),
        (["--world_model", "nowhere"], "holds no checkpoint"),
        (["--bogus", "1"], "unrecognized arguments"),
    ],
)
def test_bad_input_gets_one_clear_line(smoke, arguments, message):
    folder, _ = smoke
    result = run(folder, "--smoke", "--run", "bad", *arguments)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_other_settings_on_the_same_folder_are_refused(smoke):
    folder, _ = smoke
    existing = "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke"
    result = run(folder, "--smoke", "--run", existing, "--beta_z", "3")
    assert result.returncode == 2
    assert "other settings (beta_z: 0.1 there, 3.0 here)" in result.stderr
