"""Joint and end-to-end training as commands."""

import pytest
from commands import place_recordings, run

from dynmap_rl.modules.policy import FeedforwardPolicy
from dynmap_rl.runs.lookup import load_actor
from dynmap_rl.utils.files import read_json


@pytest.mark.parametrize(
    ("recipe", "name", "row", "paper"),
    [
        (
            "joint",
            "position_velocity_recurrent",
            "RGB+[P+V]",
            "DR 9 (1.9) %   PE 54 (11.0) mm   SR 59 (9.6) %",
        ),
        ("end_to_end", "recurrent", "End-to-End", "DR 19 (9.0) %   PE 71 (21.9) mm   SR 57 (10.6) %"),
    ],
)
def test_smoke_run_and_its_world_model_taken_to_task_3(recordings, tmp_path, recipe, name, row, paper):
    place_recordings(tmp_path, recordings, "balance_reaching", "bin_dropping")
    arguments = "--smoke", "--seeds", "0,1"
    result = run(tmp_path, recipe, *arguments)
    assert result.returncode == 0, result.stderr
    assert paper in result.stdout
    folder = tmp_path / "runs" / recipe / "balance_reaching" / f"{name}_smoke"
    evaluation = read_json(folder / "eval.json")
    assert evaluation["row"] == row
    assert evaluation["world_model"] == {"task": "balance_reaching", "training": recipe}
    shas = [seed["world_model_sha256"] for seed in evaluation["results"]]
    assert shas[0] != shas[1], "every seed has a world model of its own"
    assert (folder / "rollouts.gif").stat().st_size > 1000
    assert "is done" in run(tmp_path, recipe, *arguments).stdout

    frozen = run(tmp_path, "generalize", "--smoke", "--task", "bin_dropping", "--world_model", str(folder))
    assert frozen.returncode == 0, frozen.stderr
    taken = tmp_path / f"runs/generalize/bin_dropping/{recipe}"
    [taken] = taken.parent.glob(f"{recipe}_*")
    assert read_json(taken / "eval.json")["world_model_sha256"] == shas[0]
    assert read_json(taken / "eval.json")["row"] == row


@pytest.mark.parametrize("recipe", ["joint", "end_to_end"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--updates", "0"], "--updates must be at least 1"), (["--policy", "transformer"], "unknown policy")],
)
def test_bad_input_is_refused_before_anything_is_written(tmp_path, recipe, arguments, message):
    result = run(tmp_path, recipe, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("recipe", "row"), [("joint", "RGB+[P+V]"), ("end_to_end", "End-to-End")])
def test_a_feedforward_policy(recordings, tmp_path, recipe, row):
    place_recordings(tmp_path, recordings, "balance_reaching")
    result = run(tmp_path, recipe, "--smoke", "--policy", "feedforward")
    assert result.returncode == 0, result.stderr
    assert f"{row}, feedforward policy, balance_reaching" in result.stdout.replace(", joint,", ",")
    [folder] = (tmp_path / "runs" / recipe / "balance_reaching").iterdir()
    assert isinstance(load_actor(folder, 0).policy, FeedforwardPolicy)
