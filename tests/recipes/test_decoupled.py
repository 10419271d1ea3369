import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import open_in_browser, run
from safetensors.torch import load_file, save_file

from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.training.dataset import find_or_record
from recipes.decoupled import Config, main

RECIPE = Path(__file__).parents[2] / "recipes" / "decoupled.py"


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """One smoke run as a process with no other option: it records, trains, evaluates and draws."""
    folder = tmp_path_factory.mktemp("smoke")
    command = [sys.executable, str(RECIPE), "--smoke"]
    result = subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True)
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
    assert evaluation["test_protocol"]["episodes"] == 3
    assert len(evaluation["results"][0]["test"]["rows"]["success"]) == 3
    for name in ("figures/reconstruction.png", "figures/dynamics.png", "rollouts.gif"):
        assert (run_folder / name).stat().st_size > 1000
    assert not (run_folder / "features").exists()
    page = (run_folder / "report.html").read_text()
    assert "SR 89 (0.9) %" in page and page.count('src="data:image/') == 3


def test_its_page_is_whole_in_a_browser(smoke, tmp_path):
    folder, _ = smoke
    page = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke/report.html"
    seen = open_in_browser(page, tmp_path / "page.png")
    assert seen["loaded"] and seen["console"] == []
    assert seen["requests"] == [page.as_uri()[:100]], "nothing from elsewhere"
    assert len(seen["images"]) == 3 and min(seen["images"]) > 100, "reconstruction, dynamics and rollouts"
    assert seen["drawings"] and min(seen["drawings"]) > 500, "the curves"
    for said in ("RGB+[P+V], recurrent policy", "SR 89 (0.9) %", "Rollouts in closed loop", "policy_updates"):
        assert said in seen["text"]


def test_the_same_command_again_says_that_it_is_done(smoke, monkeypatch, capsys):
    folder, first = smoke
    monkeypatch.chdir(folder)
    main(Config(smoke=True))
    again = capsys.readouterr().out
    assert "is done" in again
    assert first.stdout.split("\n")[1] in again


def test_two_seeds_in_processes_on_a_world_model_that_is_there(smoke):
    folder, _ = smoke
    runs = folder / "runs/decoupled/balance_reaching"
    trained = runs / "position_velocity_recurrent_smoke/world_model"
    arguments = ["--policy", "feedforward", "--seeds", "0,1", "--world_model", str(trained)]
    result = run(folder, "decoupled", "--smoke", *arguments)
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
def test_bad_input_is_refused_before_anything_is_written(tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        main(Config(run=tmp_path / "bad", **settings))
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
        ("", {"updates": 5}, "--updates is of a world model's training, and that of --world_model is done"),
    ],
)
def test_a_world_model_of_another_row_is_refused(smoke, tmp_path, path, settings, message):
    folder, _ = smoke
    trained = folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke" / path
    with pytest.raises(ValueError, match=message):
        main(Config(smoke=True, world_model=trained, run=tmp_path / "bad", **settings))
    assert not (tmp_path / "bad").exists()


def test_a_world_model_that_is_no_longer_the_same_is_noticed(smoke, tmp_path):
    folder, _ = smoke
    source = tmp_path / "source"
    shutil.copytree(folder / "runs/decoupled/balance_reaching/position_velocity_recurrent_smoke", source)
    data = str(folder / "datasets/balance_reaching_smoke")
    settings = {"smoke": True, "world_model": source, "run": tmp_path / "run", "dataset": data}
    main(Config(**settings))
    weights = source / "world_model/weights.safetensors"
    save_file({name: value + 1 for name, value in load_file(weights).items()}, weights)
    with pytest.raises(ValueError, match="was made with another world model"):
        main(Config(**settings))


def test_the_dataset_that_is_there_is_taken(recording, tmp_path, monkeypatch):
    """Of any number of episodes, but of demonstrations of the task."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(recording, "datasets/balance_reaching")
    assert find_or_record(Config()) == Path("datasets/balance_reaching")
    for changes, message in (
        ({"kind": "exploration"}, "is of exploration"),
        ({"task": "bin_dropping"}, "is of bin"),
    ):
        path = Path("datasets/balance_reaching/meta/dynmap.json")
        path.write_text(json.dumps(json.loads((recording / "meta/dynmap.json").read_text()) | changes))
        with pytest.raises(ValueError, match=message):
            find_or_record(Config())


@pytest.mark.parametrize("task", sorted({*TASKS} - {"balance_reaching"}))
def test_smoke_run_of_another_task(recordings, tmp_path, capsys, task):
    main(Config(smoke=True, task=task, dataset=str(recordings(task)), run=tmp_path))
    evaluation = json.loads((tmp_path / "eval.json").read_text())
    assert (evaluation["task"], evaluation["row"]) == (task, "RGB+[P+V]")
    assert evaluation["world_model"] == {"task": task, "training": "decoupled"}
    assert evaluation["trained_on"]["episodes"] == 4
    printed = capsys.readouterr().out
    assert f"RGB+[P+V], recurrent policy, {task}" in printed
    assert "\n  paper  " not in printed, "its world models are of task 1"
