"""Decoupled training as a command: results, resuming, and what is refused."""

import json
import shutil

import pytest
from commands import PRESETS, run, run_small

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.modules.checkpoints import load_world_model
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training.settings import WorldModelTraining
from dynmap_rl.utils.files import read_json, write_json

NAME = "runs/decoupled/balance_reaching/position_velocity_recurrent"
WEIGHTS = "world_model/weights.safetensors"


@pytest.fixture(scope="module")
def small(tmp_path_factory, small_run):
    """Return a folder with a finished run, and its output."""
    folder = shutil.copytree(
        small_run, tmp_path_factory.mktemp("decoupled"), dirs_exist_ok=True, symlinks=True
    )
    return folder, (small_run / "printed.txt").read_text()


def test_a_run_has_results_figures_and_a_page(small):
    folder, printed = small
    assert "RGB+[P+V], recurrent policy" in printed
    assert "89 (0.9)" in printed, "the paper's success rate"
    evaluation = read_json(folder / NAME / "eval.json")
    assert evaluation["row"] == "RGB+[P+V]"
    assert evaluation["trained_on"]["episodes"] == 4
    assert evaluation["test_protocol"]["episodes"] == 3
    assert evaluation["settings"]["world_model"]["updates"] == 4
    assert evaluation["command"].startswith("python recipes/decoupled.py --config_path ")
    for name in ("figures/reconstruction.png", "figures/dynamics.png", "rollouts.gif"):
        assert (folder / NAME / name).stat().st_size > 1000
    assert not (folder / NAME / "features").exists()
    page = (folder / NAME / "report.html").read_text()
    assert "89 (0.9)" in page and page.count('src="data:image/') == 3


def test_the_same_command_prints_the_result_again(small):
    folder, printed = small
    before = (folder / NAME / WEIGHTS).stat().st_mtime_ns
    again = run_small(folder, "decoupled", "--compute.threads", "2")
    assert "complete" in again.stdout and printed.split("\n")[1] in again.stdout
    assert (folder / NAME / WEIGHTS).stat().st_mtime_ns == before


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("--world_model.updates=7", "world_model.updates: 4 there, 7 here"),
        ("--eval.split=validation", "eval.split"),
    ],
)
def test_other_settings_are_refused_and_named(small, option, name):
    result = run(small[0], "decoupled", "--config_path", PRESETS / "decoupled.yaml", option)
    assert result.returncode == 2 and name in result.stderr


def test_a_run_of_the_first_release_is_refused_in_one_line(small, tmp_path):
    folder = shutil.copytree(small[0] / NAME, tmp_path / "old")
    write_json(folder / "config.json", {"task": "balance_reaching", "updates": 4, "policy_updates": 3})
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}
    preset, data = PRESETS / "decoupled.yaml", small[0] / "datasets/balance_reaching"
    result = run(tmp_path, "decoupled", "--config_path", preset, "--run", "old", "--dataset", data)
    assert result.returncode == 2 and result.stderr.count("\n") == 1 and "--run" in result.stderr
    assert before == {path: path.stat().st_mtime_ns for path in before}


@pytest.mark.slow
def test_policies_on_a_world_model_of_another_run(small):
    folder, _ = small
    run_small(
        folder, "decoupled", *options(f"{NAME}/world_model"), "--policy.kind", "feedforward", "--seeds", "0,1"
    )
    other = folder / "runs/decoupled/balance_reaching/position_velocity_feedforward"
    assert (other / WEIGHTS).read_bytes() == (folder / NAME / WEIGHTS).read_bytes()
    policies = [(other / f"seed_{seed}/policy/weights.safetensors").read_bytes() for seed in (0, 1)]
    assert policies[0] != policies[1]


def options(pretrained):
    """Return options that undo the preset's sizes of the world model, which have no effect with ``--pretrained``."""
    sizes = ("updates", "windows", "window_steps")
    defaults = (f"--world_model.{name}={getattr(WorldModelTraining(), name)}" for name in sizes)
    return ["--pretrained", pretrained, *defaults]


@pytest.mark.parametrize(
    ("path", "arguments", "message"),
    [
        ("", ["--world_model.supervision", "none"], "--world_model.supervision none"),
        ("world_model", ["--task", "bin_dropping"], "recipes/generalize.py"),
        ("seed_0/policy", [], "no finished run"),
        ("", ["--world_model.updates", "5"], "--world_model.updates has no effect with --pretrained"),
    ],
)
def test_a_world_model_that_does_not_fit_is_refused(small, path, arguments, message):
    folder, _ = small
    result = run(folder, "decoupled", "--pretrained", f"{NAME}/{path}", "--run", "runs/bad", *arguments)
    assert result.returncode == 2 and message in result.stderr
    assert not (folder / "runs/bad").exists()


@pytest.mark.slow
@pytest.mark.parametrize("task", ["balance_reaching_obstacle", "bin_dropping"])
def test_other_tasks(recordings, tmp_path, task):
    result = run_small(tmp_path, "decoupled", "--task", task, "--dataset", recordings(task), "--run", "run")
    evaluation = json.loads((tmp_path / "run/eval.json").read_text())
    assert (evaluation["task"], evaluation["row"]) == (task, "RGB+[P+V]")
    assert evaluation["world_model"] == {"task": task, "training": "decoupled"}
    assert "  paper " not in result.stdout, "its world models are of task 1"


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{"source": "centroid"}, {"columns": [0, 1, 2], "angles": [2]}], ids=["centroid", "command"]
)
def test_a_recording_with_other_dynamics_trains_and_is_evaluated(recording, tmp_path, settings):
    """With two and with three entries in the place of six, partly labelled and without the RGB loss."""
    add_dynamics(recording, tmp_path / "other", **settings, replace=True)
    options = "--world_model.labelled", "0.5", "--world_model.beta_rgb", "0"
    run_small(tmp_path, "decoupled", "--dataset", tmp_path / "other", "--run", "run", *options, pictures=True)
    result = read_json(tmp_path / "run/eval.json")
    assert result["row"] == "RGB+[P+V]" and "localization" not in result["test_protocol"]
    assert load_world_model(tmp_path / "run/world_model").dynamics_decoder.normalizers["position"].size in (
        2,
        3,
    )
    assert {"error_position", "error_rgb"} <= read_metrics(tmp_path / "run")[-1].keys()
    assert (tmp_path / "run/figures/dynamics.png").exists()
