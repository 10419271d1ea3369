import shutil
from pathlib import Path

import pytest
from commands import place_recordings, run
from safetensors.torch import load_file, save_file

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.runs.lookup import load_source
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.weights import fingerprint
from recipes.generalize import Config, main


@pytest.fixture(scope="module")
def smoke(tmp_path_factory, recordings):
    """A smoke run of task 1, and its world model taken to task 3."""
    folder = tmp_path_factory.mktemp("smoke")
    place_recordings(folder, recordings, "balance_reaching", "bin_dropping")
    source = run(folder, "decoupled", "--smoke", "--supervision", "none")
    assert source.returncode == 0, source.stderr
    trained = "runs/decoupled/balance_reaching/none_recurrent_smoke"
    result = run(folder, "generalize", "--smoke", "--task", "bin_dropping", "--world_model", trained)
    assert result.returncode == 0, result.stderr
    return folder, trained, result


def test_the_world_model_is_that_of_task_1(smoke):
    folder, trained, _ = smoke
    run_folder = folder / "runs/generalize/bin_dropping/decoupled_none_recurrent_smoke"
    evaluation = read_json(run_folder / "eval.json")
    assert evaluation["task"] == "bin_dropping"
    assert evaluation["world_model"] == {"task": "balance_reaching", "training": "decoupled"}
    assert evaluation["world_model_sha256"] == read_json(folder / trained / "eval.json")["world_model_sha256"]
    weights = "world_model/weights.safetensors"
    assert (run_folder / weights).read_bytes() == (folder / trained / weights).read_bytes()
    assert load_meta(folder / "datasets/bin_dropping_smoke")["task"] == "bin_dropping"


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


def test_the_folder_of_the_world_model_is_as_good_as_that_of_its_run(smoke):
    folder, trained, _ = smoke
    model, source = load_source(folder / trained)
    same, same_source = load_source(folder / trained / "world_model")
    assert fingerprint(model) == fingerprint(same)
    assert source == same_source == {"task": "balance_reaching", "training": "decoupled"}


def test_another_world_model_in_its_place_is_refused(smoke, tmp_path, monkeypatch):
    folder, trained, _ = smoke
    shutil.copytree(folder / "runs", tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    weights = tmp_path / trained / "world_model/weights.safetensors"
    state = load_file(weights)
    next(iter(state.values())).view(-1)[0] += 1e-3
    save_file(state, weights)
    with pytest.raises(ValueError, match="was made with another world model"):
        main(Config(smoke=True, task="bin_dropping", world_model=Path(trained)))


def test_a_jointly_trained_world_model_stands_beside_the_papers(smoke, tmp_path, monkeypatch, capsys):
    folder, trained, _ = smoke
    source = shutil.copytree(folder / trained, tmp_path / "source")
    joint = {"task": "balance_reaching", "training": "joint"}
    write_json(source / "eval.json", read_json(source / "eval.json") | {"world_model": joint})
    monkeypatch.chdir(tmp_path)
    dataset = str(folder / "datasets/bin_dropping_smoke")
    main(Config(smoke=True, task="bin_dropping", world_model=source, dataset=dataset))
    assert "SR 46 (1.6) %" in capsys.readouterr().out
    result = read_json("runs/generalize/bin_dropping/joint_none_recurrent_smoke/eval.json")
    assert result["world_model"] == joint


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
            "is of balance_reaching, not of",
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
