"""The expert recipe: run folder, page, help and errors. tests/training/test_ppo.py tests the training."""

import subprocess
import sys
from pathlib import Path

import pytest
from commands import PRESETS, run, run_small

from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.utils.files import read_json

RECIPE = Path(__file__).parents[2] / "recipes/expert.py"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("expert")
    return folder, run_small(folder, "expert", "--run", "run")


def test_a_run_has_checkpoints_and_a_page(finished):
    folder, result = finished
    assert list_checkpoints(folder / "run/checkpoint") == ["iteration_001", "iteration_002"]
    facts = read_json(folder / "run/checkpoint/iteration_002.json")
    assert (facts["task"], facts["episodes"]) == ("balance_reaching", 4)
    page = (folder / "run/report.html").read_text()
    assert "success 0.0 %" in page and "success 0.0 %" in result.stdout


def test_other_settings_are_refused_and_named(finished):
    folder, _ = finished
    result = run(
        folder, "expert", "--config_path", PRESETS / "expert.yaml", "--run", "run", "--ppo.gamma", "0.9"
    )
    assert result.returncode == 2 and "ppo.gamma: 0.97 there, 0.9 here" in result.stderr


def test_more_iterations_resume_the_run(finished, tmp_path):
    folder, _ = finished
    run_small(folder, "expert", "--run", "run", "--ppo.iterations", "3")
    assert list_checkpoints(folder / "run/checkpoint")[-1] == "iteration_003"
    assert read_json(folder / "run/config.json")["ppo"]["iterations"] == 2, "those it began with"
    result = run(
        folder, "expert", "--config_path", PRESETS / "expert.yaml", "--run", "run", "--ppo.iterations", "1"
    )
    assert result.returncode == 2 and "--ppo.iterations must be at least the 3" in result.stderr


@pytest.mark.parametrize("arguments", [["--task", "nope"], ["--threads", "0"], ["--ppo.epochs", "0"]])
def test_bad_input_is_refused_before_anything_is_written(tmp_path, arguments):
    result = run(tmp_path, "expert", *arguments)
    assert result.returncode == 2 and result.stderr.count("\n") == 1
    assert arguments[0].rpartition(".")[2].strip("-") in result.stderr
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("recipe", ["expert", "decoupled", "collect"])
def test_help_does_not_import_torch(recipe):
    command = [sys.executable, "-X", "importtime", RECIPE.with_name(f"{recipe}.py"), "--help"]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0 and "--task" in result.stdout
    imported = {line.rsplit("|")[-1].strip().split(".")[0] for line in result.stderr.splitlines()}
    assert "draccus" in imported
    assert not imported & {"torch", "lerobot", "datasets", "pygame", "matplotlib"}
