import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.envs.tasks import TASKS

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


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("decoupled_recipe", ROOT / "recipes" / "decoupled.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["decoupled_recipe"] = module
    spec.loader.exec_module(module)
    return module


def test_smoke_run_leaves_everything_behind(smoke):
    folder, result = smoke
    run_folder = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke"
    assert "RGB+[P+V], recurrent policy" in result.stdout
    assert "DR 5 (2.5) %   PE 23 (3.7) mm   SR 89 (0.9) %" in result.stdout  # the paper's row
    evaluation = json.loads((run_folder / "eval.json").read_text())
    assert evaluation["row"] == "RGB+[P+V]"
    assert evaluation["trained_on"]["episodes"] == 4
    assert evaluation["test_protocol"]["episodes"] == 3
    assert len(evaluation["results"][0]["test"]["rows"]["success"]) == 3
    for name in ("figures/reconstruction.png", "figures/dynamics.png", "rollouts.gif"):
        assert (run_folder / name).stat().st_size > 1000
    assert not (run_folder / "features").exists()


def test_the_same_command_again_says_that_it_is_done(smoke, recipe, monkeypatch, capsys):
    folder, first = smoke
    monkeypatch.chdir(folder)
    recipe.main(recipe.Config(smoke=True))
    again = capsys.readouterr().out
    assert "is done" in again
    assert first.stdout.split("\n")[1] in again


def test_two_seeds_in_processes_on_a_world_model_that_is_there(smoke):
    folder, _ = smoke
    runs = folder / "runs/decoupled/balance_reaching"
    trained = runs / "position_velocity_recurrent_smoke/world_model"
    arguments = ["--policy", "feedforward", "--seeds", "0,1", "--world_model", str(trained)]
    result = run(folder, "--smoke", *arguments)
    assert result.returncode == 0, result.stderr
    assert "recording" not in result.stderr
    other = runs / "position_velocity_feedforward_smoke"
    weights = "world_model/weights.safetensors"
    assert (other / weights).read_bytes() == (trained.parent / weights).read_bytes()
    policies = [(other / f"seed_{seed}/policy/weights.safetensors").read_bytes() for seed in (0, 1)]
    assert policies[0] != policies[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"supervision": "jerk"}, "unknown supervision"),
        ({"policy": "transformer"}, "unknown policy"),
        ({"dataset": "no/where/here"}, "no dataset at no/where/here"),
        ({"world_model": Path("nowhere")}, "nowhere holds no finished run"),
        ({"task": "juggling"}, "unknown task"),
        ({"seeds": "0,0"}, "has one twice"),
        ({"seeds": "a"}, "whole numbers"),
        ({"window_steps": 500}, "window_steps must be"),
        ({"test_episodes": 0}, "at least 1"),
        ({"test_episodes": 1001}, "1000 shared start states"),
        ({"split": "train"}, "test or validation"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(recipe, tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        recipe.main(recipe.Config(run=tmp_path / "bad", **settings))
    assert not (tmp_path / "bad").exists()


@pytest.mark.parametrize(
    ("path", "settings", "message"),
    [
        (
            "",
            {"supervision": "none"},
            r"is a world model of balance_reaching, decoupled, supervised on \('pos",
        ),
        ("world_model", {"task": "bin_dropping"}, "is a world model of balance_reaching, .* use recipes/gen"),
        ("seed_0/policy", {}, "holds no finished run"),
    ],
)
def test_a_world_model_of_another_row_is_refused(smoke, recipe, tmp_path, path, settings, message):
    folder, _ = smoke
    trained = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke" / path
    with pytest.raises(ValueError, match=message):
        recipe.main(recipe.Config(smoke=True, world_model=trained, run=tmp_path / "bad", **settings))
    assert not (tmp_path / "bad").exists()


@pytest.mark.parametrize("task", sorted({*TASKS} - {"balance_reaching"}))
def test_smoke_run_of_another_task(recipe, recordings, tmp_path, capsys, task):
    recipe.main(recipe.Config(smoke=True, task=task, dataset=str(recordings(task)), run=tmp_path))
    evaluation = json.loads((tmp_path / "eval.json").read_text())
    assert (evaluation["task"], evaluation["row"]) == (task, "RGB+[P+V]")
    assert evaluation["world_model"] == {"task": task, "training": "decoupled"}
    assert evaluation["trained_on"]["episodes"] == 4
    printed = capsys.readouterr().out
    assert f"RGB+[P+V], recurrent policy, {task}" in printed
    assert "\n  paper  " not in printed, "its world models are of task 1"


def test_an_unknown_option_gets_one_clear_line(tmp_path):
    result = run(tmp_path, "--bogus", "1")
    assert result.returncode == 2
    assert "unrecognized arguments: --bogus" in result.stderr
    assert "Traceback" not in result.stderr


def test_other_settings_on_the_same_folder_are_refused(smoke, recipe, monkeypatch):
    folder, _ = smoke
    monkeypatch.chdir(folder)
    existing = Path("runs/decoupled/balance_reaching/position_velocity_recurrent_smoke")
    with pytest.raises(ValueError, match=r"other settings \(beta_z: 0.1 there, 3.0 here\)"):
        recipe.main(recipe.Config(smoke=True, run=existing, beta_z=3.0))
