"""Start of runs: the recipe's arguments, the result, and messages of those that fail."""

import json
import os
import sys
from pathlib import Path
from threading import Event

import pytest

from dynmap_rl.paper.cells import Run
from dynmap_rl.paper.launch import execute, has_run, is_done, launch
from dynmap_rl.utils.cluster import check_launcher

CELL = "bin_dropping", "joint", "recurrent", "Only-RGB"
RUN = Run("b", "generalize", CELL, ("--task", "bin_dropping"), needs="a")
FOLDERS = {"recipes": Path("/recipes"), "results": Path("results"), "runs": Path("runs")}


@pytest.fixture
def scripts(monkeypatch):
    """Return the calls of a stand-in for ``run_script``, which writes a result."""
    calls = []

    def run_script(script, arguments, folder, log):
        calls.append((script, arguments))
        run = folder / arguments[arguments.index("--run") + 1]
        run.mkdir(parents=True, exist_ok=True)
        (run / "eval.json").write_text('{"run": 1}')
        return 0

    monkeypatch.setattr("dynmap_rl.paper.launch.run_script", run_script)
    return calls


def test_the_result_of_a_run_is_kept(scripts, tmp_path):
    assert execute(RUN, **FOLDERS, threads=1, root=tmp_path) is None
    script, arguments = scripts[0]
    assert script == Path("/recipes/generalize.py")
    assert " ".join(arguments) == "--task bin_dropping --run runs/b --compute.threads 1 --pretrained runs/a"
    assert has_run("b", tmp_path / "runs") and is_done("b", tmp_path / "results")
    assert json.loads((tmp_path / "results/b.json").read_text()) == {"run": 1}


def test_a_result_that_is_there_stays(scripts, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/b.json").write_text('{"run": 0}')
    execute(RUN, **FOLDERS, root=tmp_path)
    assert json.loads((tmp_path / "results/b.json").read_text()) == {"run": 0}


def test_presets_are_of_recipes(scripts, tmp_path):
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets/generalize.yaml").touch()
    execute(RUN, **FOLDERS, presets=Path("presets"), root=tmp_path)
    execute(Run("c", "joint", CELL), **FOLDERS, presets=Path("presets"), root=tmp_path)
    assert scripts[0][1][-2:] == ["--config_path", str(tmp_path / "presets/generalize.yaml")]
    assert "--config_path" not in scripts[1][1]


@pytest.mark.parametrize(("output", "last"), [("a\nerror: b\n", "error: b"), ("", "no output")])
def test_the_message_of_a_failed_run_is_the_last_line_of_its_output(monkeypatch, tmp_path, output, last):
    def run_script(script, arguments, folder, log):
        log.write_text(output)
        return 2

    monkeypatch.setattr("dynmap_rl.paper.launch.run_script", run_script)
    message = execute(RUN, **FOLDERS, root=tmp_path)
    assert message == f"b failed; see runs/b.log, which ends with: {last}"
    assert not is_done("b", tmp_path / "results")


RUNS = [Run(name, "joint", CELL) for name in "abc"]


def fail_at_b(run):
    return "b failed" if run.name == "b" else None


def test_runs_that_fail_do_not_stop_the_others(capsys):
    assert launch(RUNS, fail_at_b) == ["b failed"]
    assert capsys.readouterr().out.splitlines() == ["done: a", "b failed", "done: c"]
    assert launch([], fail_at_b) == []


def test_workers_run_at_the_same_time():
    begun = {run.name: Event() for run in RUNS}

    def wait_for_others(run):
        begun[run.name].set()
        return None if all(event.wait(20) for event in begun.values()) else "alone"

    assert launch(RUNS, wait_for_others, workers=3) == []


def test_a_run_waits_for_the_world_model_that_it_needs_while_others_go_ahead():
    needing, begun, done = Run("d", "generalize", CELL, needs="a/seed_1"), Event(), []

    def start(run):
        if run.name == "c":
            begun.set()
        message = None if run.name != "a" or begun.wait(20) else "c waits for nothing"
        done.append(run.name)
        return message

    assert launch([RUNS[0], needing, RUNS[2]], start, workers=2) == []
    assert done.index("a") < done.index("d")


def test_a_run_does_not_start_without_the_world_model_that_it_needs(capsys):
    needing = Run("d", "generalize", CELL, needs="b")
    messages = launch([*RUNS, needing], fail_at_b, workers=2)
    assert sorted(messages) == ["b failed", "d needs the world model of a failed run"]
    assert sorted(capsys.readouterr().out.splitlines()) == sorted([*messages, "done: a", "done: c"])


def test_an_interrupt_begins_no_other_run():
    begun = []

    def interrupt(run):
        begun.append(run.name)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        launch(RUNS[:1], interrupt)
    assert begun == ["a"]


def test_launchers_are_checked(monkeypatch):
    check_launcher("local")
    with pytest.raises(ValueError, match="got 'slurm'"):
        launch(RUNS, fail_at_b, "slurm")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install -e '\.\[ray\]'"):
        launch(RUNS, fail_at_b, "ray")


@pytest.mark.slow
def test_ray_reports_a_run_whose_process_died(ray):
    def die_at_b(run):
        return os._exit(1) if run.name == "b" else None

    messages = launch(RUNS, die_at_b, "ray", cpus=1)
    assert messages == ["b was lost by Ray (WorkerCrashedError); the same command resumes"]
