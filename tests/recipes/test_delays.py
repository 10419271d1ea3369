"""The grid of delays, in a small size: cells, resuming, page and figure."""

import shutil
from pathlib import Path

import pytest
import torch
from commands import run
from small import CONSTANTS, make_model

from dynmap_rl.modules.checkpoints import make_policy, save_policy, save_world_model
from dynmap_rl.utils.files import read_json, write_json
from recipes.paper import delays

RESULTS = Path(__file__).parents[2] / "recipes/results/delays"


def make_run(folder, task="balance_reaching", seed=0):
    """Make a run, ``trained``, with an untrained policy."""
    world_model = make_model()
    torch.manual_seed(seed)
    save_world_model(folder / "trained/world_model", world_model)
    policy = make_policy(CONSTANTS, "recurrent", world_model)
    save_policy(folder / "trained/seed_0/policy", policy, world_model)
    write_json(folder / "trained/config.json", {"task": task})


@pytest.fixture
def grid(tmp_path):
    """Return a function that runs the recipe on an untrained policy."""
    make_run(tmp_path)

    def call(*arguments):
        common = "--runs", "trained", "--eval.episodes", 2, "--results", "found"
        return run(tmp_path, "delays", *common, *arguments)

    return call


def test_cells_are_measured_once(grid, tmp_path):
    conditions = "--conditions", "stale,imagined,error_-3,pushed"
    result = grid(*conditions, "--delays", "2", "--dry_run")
    assert result.returncode == 0, result.stderr
    assert len(result.stdout.splitlines()) == 3, "error_-3 needs a delay of three steps"
    assert not (tmp_path / "found").exists()
    result = grid(*conditions, "--delays", "2")
    assert result.returncode == 0, result.stderr
    files = {
        path.stem.removeprefix("balance_reaching_trained_seed_0_"): path
        for path in (tmp_path / "found").glob("*.json")
    }
    assert set(files) == {"stale", "imagined", "pushed"}
    found = {name: read_json(path) for name, path in files.items()}
    assert all(set(part["cells"]) == {"2"} and part["row"] == "RGB+[P]" for part in found.values())
    assert len({part["cells"]["2"]["PE"] for part in found.values()}) == 3
    before = {name: path.read_bytes() for name, path in files.items()}
    result = grid(*conditions, "--delays", "2,4")
    assert result.returncode == 0, result.stderr
    for name, path in files.items():
        assert (
            set(read_json(path)["cells"]) == {"2", "4"}
            and read_json(path)["cells"]["2"] == found[name]["cells"]["2"]
        )
        assert path.read_bytes() != before[name]
    assert {path.name for path in (tmp_path / "found").glob("*.png")} == {
        "delays.png",
        "delays_conditions.png",
    }
    page = (tmp_path / "found/README.md").read_bytes()
    (tmp_path / "found/README.md").unlink()
    assert grid("--write").returncode == 0
    assert (tmp_path / "found/README.md").read_bytes() == page
    result = grid("--conditions", "stale", "--eval.split", "validation")
    assert result.returncode == 2 and "another split" in result.stderr
    make_run(tmp_path, seed=1)
    result = grid("--conditions", "stale", "--delays", "6")
    assert result.returncode == 2 and "other weights" in result.stderr
    write_json(tmp_path / "trained/eval.json", {"command": "python recipes/decoupled.py", "commit": "abc"})
    result = grid("--conditions", "stale")
    assert result.returncode == 2 and "another training of the run" in result.stderr, (
        "the run was trained again"
    )


def test_published_results_can_be_extended(tmp_path):
    shutil.copytree(RESULTS, tmp_path / "found")
    arguments = "--runs", "balance_reaching", "--results", "found", "--dry_run"
    result = run(tmp_path, "delays", *arguments)
    assert result.returncode == 0, result.stderr


def test_cells_that_another_process_has_added_stay(tmp_path, monkeypatch):
    config = delays.Config(runs="balance_reaching", results=tmp_path)
    path, result = delays.open_result(config, "balance_reaching", "stale")
    other = read_json(next(RESULTS.glob("balance_reaching_balance_reaching_seed_0_stale.json")))["cells"]["4"]
    write_json(path, result | {"cells": {"4": other}})
    names = {"row": "RGB+[P+V]", "policy": "recurrent", "weights_sha256": "a"}
    monkeypatch.setattr(delays, "load_actor", lambda *_: (None, names))
    summary = dict.fromkeys(("SR", "SR_interval", "DR", "DR_interval", "PE"), 1.0)
    found = {"test": {"summary": summary, "rows": {"success": "1"}}}
    monkeypatch.setattr("dynmap_rl.evaluation.protocol.evaluate", lambda *_: found)
    delays.evaluate_cell(config, path, result, 2)
    assert set(read_json(path)["cells"]) == {"2", "4"} and read_json(path)["cells"]["4"] == other


def test_what_a_task_in_space_cannot_have_is_left_out(tmp_path):
    make_run(tmp_path, task="mujoco:FetchPush")
    arguments = "--runs", "trained", "--results", "found", "--delays", "2", "--dry_run"
    result = run(tmp_path, "delays", *arguments)
    assert result.returncode == 0, result.stderr
    assert "jitter" in result.stdout and "pushed" not in result.stdout


def test_the_baseline_with_past_actions_is_trained_on_the_run_s_world_model(grid, tmp_path, recording):
    result = grid(
        "--conditions", "past_actions", "--delays", "0,2", "--dataset", recording, "--policy.updates", 2
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    found = read_json(tmp_path / "found/balance_reaching_trained_seed_0_past_actions.json")
    assert set(found["cells"]) == {"0", "2"} and found["policy"] == "feedforward"
    result = grid("--conditions", "past_actions", "--dataset", recording, "--policy.updates", 3)
    assert result.returncode == 2 and "another training" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--conditions", "fog"], "fog"),
        (["--delays", "2,soon"], "soon"),
        (["--runs", "nothing"], "nothing"),
        (["--write"], "found must have results"),
        (["--eval.paper_episodes", "5"], "--eval.paper_episodes"),
        (["--policy.kind", "recurrent"], "--policy.kind"),
    ],
)
def test_bad_input_gets_one_clear_line(grid, tmp_path, arguments, message):
    result = grid(*arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not (tmp_path / "found").exists() and not (tmp_path / "delays.png").exists()
