"""Joint and end-to-end training as commands."""

import shutil

import pytest
from commands import place_recordings, run, run_small
from small import read_weights

from dynmap_rl.modules.policy import FeedforwardPolicy
from dynmap_rl.runs.lookup import load_actor
from dynmap_rl.utils.files import read_json, write_json


@pytest.fixture
def place(recordings, tmp_path):
    place_recordings(tmp_path, recordings, "balance_reaching", "bin_dropping")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("recipe", "name", "row", "paper"),
    [
        ("joint", "position_velocity_recurrent", "RGB+[P+V]", "59 (9.6)"),
        ("end_to_end", "recurrent", "End-to-End", "57 (10.6)"),
    ],
)
def test_a_run_has_results_and_is_not_repeated(place, recipe, name, row, paper):
    result = run_small(place, recipe)
    assert paper in result.stdout
    folder = place / "runs" / recipe / "balance_reaching" / name
    evaluation = read_json(folder / "eval.json")
    assert evaluation["row"] == row
    assert evaluation["world_model"] == {"task": "balance_reaching", "training": recipe}
    assert evaluation["settings"]["training"]["updates"] == 4
    assert (folder / "report.html").exists()
    before = read_weights(folder)
    assert "complete" in run_small(place, recipe).stdout
    assert read_weights(folder) == before


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["joint", "end_to_end"])
def test_a_dataset_without_held_out_episodes_is_divided(recordings, tmp_path, recipe):
    """LeRobot's tools leave one split, and drop our metadata."""
    shutil.copytree(recordings("balance_reaching"), tmp_path / "edited")
    info = tmp_path / "edited/meta/info.json"
    content = read_json(info)
    write_json(info, content | {"splits": {"train": f"0:{content['total_episodes']}"}})
    (info.parent / "dynmap.json").unlink()
    run_small(tmp_path, recipe, "--dataset", "edited", "--run", "run")
    assert (tmp_path / "run/eval.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["joint", "end_to_end"])
def test_its_world_model_on_task_3(place, recipe):
    run_small(place, recipe, "--run", "run", "--policy.kind", "feedforward", pictures=True)
    assert isinstance(load_actor(place / "run").policy, FeedforwardPolicy)
    assert (place / "run/rollouts.gif").stat().st_size > 1000
    run_small(place, "generalize", "--task", "bin_dropping", "--pretrained", "run")
    [taken] = (place / "runs/generalize/bin_dropping").glob(f"{recipe}_*")
    shas = [
        read_json(path)["results"][0]["world_model_sha256"]
        for path in (place / "run/eval.json", taken / "eval.json")
    ]
    assert shas[0] == shas[1]


def test_the_weight_of_no_dynamics_is_refused(tmp_path):
    options = "--world_model.supervision", "none", "--training.beta_dynamics", "2"
    result = run(tmp_path, "joint", *options)
    assert result.returncode == 2 and "--training.beta_dynamics has no effect" in result.stderr
    assert not any(tmp_path.iterdir())


def test_end_to_end_training_has_no_dynamics(tmp_path):
    result = run(tmp_path, "end_to_end", "--world_model.supervision", "velocity")
    assert result.returncode == 2 and "supervision must be none" in result.stderr
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("recipe", ["joint", "end_to_end"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--training.updates", "0"], "updates must be at least 1"),
        (["--policy.kind", "transformer"], "'transformer'"),
        (["--training.window_steps", "200"], "--training.window_steps must be at most 120"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, recipe, arguments, message):
    result = run(tmp_path, recipe, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())
