"""The expert recipe: runs, resumes to the same weights, and answers mistakes with one line."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from dynmap_rl import runs  # MODULE
from dynmap_rl.experts import ppo  # MODULE
from recipes.expert import Config, main

RECIPE = Path(__file__).parents[2] / "recipes" / "expert.py"


def tiny(run: Path, **changes) -> Config:
    sizes = {
        "num_envs": 4,
        "iterations": 2,
        "epochs": 1,
        "minibatch": 240,
        "checkpoint_every": 1,
        "threads": 1,
    }
    return Config(run=run, eval_episodes=4, final_episodes=4, **sizes | changes)


def shell(*arguments, python: tuple[str, ...] = ()) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, *python, str(RECIPE), *map(str, arguments)], capture_output=True, text=True
    )


def metrics(run: Path) -> list[dict]:
    """All but the wall-clock time."""
    return [{k: v for k, v in row.items() if k != "seconds"} for row in runs.read_metrics(run)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("expert") / "run"
    main(tiny(run))
    return run


def test_run_folder_is_complete(finished):
    assert [row["step"] for row in metrics(finished)] == [1, 2]
    assert [row["frames"] for row in metrics(finished)] == [480, 960]
    for iteration in (1, 2):
        facts = runs.read_json(finished / "checkpoint" / f"iteration_{iteration:03d}.json")
        assert facts["iteration"] == iteration and facts["episodes"] == 4
    first, last = (load_file(finished / "checkpoint" / f"iteration_00{i}.safetensors") for i in (1, 2))
    assert any(not torch.equal(first[k], last[k]) for k in first)
    page = (finished / "report.html").read_text()
    assert (
        "[" in page
        and "Rollouts in closed loop, failures first" in page
        and "success 0.0 % [0.0, 49.0]" in page
    )


@pytest.mark.parametrize("moment", ["before the state is saved", "after the state is saved"])
@pytest.mark.parametrize("iteration", [1, 2])
def test_killed_run_resumes_to_the_same_weights(finished, tmp_path, monkeypatch, moment, iteration):
    save = runs.save_training_state

    def kill(path, **state):
        if moment.startswith("after") or state["iteration"] < iteration:
            save(path, **state)
        if state["iteration"] == iteration:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(runs, "save_training_state", kill)
        with pytest.raises(KeyboardInterrupt):
            main(tiny(tmp_path))
    main(tiny(tmp_path))
    assert metrics(tmp_path) == metrics(finished)
    expected = load_file(finished / "checkpoint" / "iteration_002.safetensors")
    resumed = load_file(tmp_path / "checkpoint" / "iteration_002.safetensors")
    assert all(torch.equal(resumed[k], expected[k]) for k in expected)


def test_threads_change_no_weight(finished, tmp_path):
    main(tiny(tmp_path, threads=2))
    assert metrics(tmp_path) == metrics(finished)
    name = "checkpoint/iteration_002.safetensors"
    assert (tmp_path / name).read_bytes() == (finished / name).read_bytes()


def test_a_run_of_an_earlier_release_is_named(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    runs.save_training_state(tmp_path / "run/checkpoint/training_state.pt", loss_module={}, iteration=1)
    with pytest.raises(ValueError, match="training_state.pt is of an earlier release; choose another --run"):
        main(tiny(tmp_path / "run"))


def test_finished_run_is_left_alone(finished, capsys):
    files = {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()}
    main(tiny(finished))
    assert "done" in capsys.readouterr().out
    assert {p: p.read_bytes() for p in finished.rglob("*") if p.is_file()} == files


def test_other_settings_on_the_same_folder_raise(finished):
    with pytest.raises(
        ValueError, match=r"holds a run with other settings \(gamma: 0\.97 there, 0\.9 here\)"
    ):
        main(tiny(finished, gamma=0.9))


def test_unknown_task_leaves_no_folder(tmp_path):
    with pytest.raises(ValueError, match="unknown task 'nope'"):
        main(tiny(tmp_path / "run", task="nope"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("arguments", [("--nope", 3), ("--iterations", "many"), ("--seed",)])
def test_mistake_on_the_command_line_is_one_line(arguments):
    result = shell(*arguments)
    assert result.returncode == 2
    [line] = result.stderr.splitlines()
    assert line.startswith("error: ") and arguments[0].strip("-") in line


def test_help_is_quick_to_import():
    result = shell("--help", python=("-X", "importtime"))
    assert result.returncode == 0 and "--task" in result.stdout
    imported = {line.rsplit("|")[-1].strip().split(".")[0] for line in result.stderr.splitlines()}
    assert "draccus" in imported
    assert not imported & {"torch", "lerobot", "pygame", "matplotlib"}


def test_a_loss_that_is_not_finite_stops_the_run_and_what_was_kept_stays(tmp_path, monkeypatch):
    whole, calls = ppo.update, []

    def break_the_third(batch, loss_module, *rest):
        calls.append(1)
        if len(calls) == 3:
            batch["next", "reward"][0] = float("nan")
        return whole(batch, loss_module, *rest)

    monkeypatch.setattr(ppo, "update", break_the_third)
    with pytest.raises(ValueError, match="the loss is not finite; what was kept before stays"):
        main(tiny(tmp_path / "run", iterations=4))
    assert runs.load_training_state(tmp_path / "run/checkpoint/training_state.pt")["iteration"] == 2
    assert all(
        v.isfinite().all() for v in load_file(tmp_path / "run/checkpoint/iteration_002.safetensors").values()
    )
    assert [row["step"] for row in metrics(tmp_path / "run")] == [1, 2]
