"""Runs of cells: the recipe's arguments, the result, and messages of those that fail."""

import json
import os
import sys
from pathlib import Path
from threading import Event

import pytest

from dynmap_rl.paper.cells import Cell
from dynmap_rl.paper.launch import has_run, is_done, launch, run_cell
from dynmap_rl.utils.cluster import check_launcher

CELL = Cell("b", "generalize", ("--task", "bin_dropping"), needs="a")
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


def test_a_cell_is_a_run_of_its_recipe_whose_result_is_kept(scripts, tmp_path):
    assert run_cell(CELL, **FOLDERS, threads=1, root=tmp_path) is None
    script, arguments = scripts[0]
    assert script == Path("/recipes/generalize.py")
    assert " ".join(arguments) == "--task bin_dropping --run runs/b --compute.threads 1 --pretrained runs/a"
    assert has_run("b", tmp_path / "runs") and is_done("b", tmp_path / "results")
    assert json.loads((tmp_path / "results/b.json").read_text()) == {"run": 1}


def test_a_result_that_is_there_stays(scripts, tmp_path):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/b.json").write_text('{"run": 0}')
    run_cell(CELL, **FOLDERS, root=tmp_path)
    assert json.loads((tmp_path / "results/b.json").read_text()) == {"run": 0}


def test_presets_are_of_recipes(scripts, tmp_path):
    (tmp_path / "presets").mkdir()
    (tmp_path / "presets/generalize.yaml").touch()
    run_cell(CELL, **FOLDERS, presets=Path("presets"), root=tmp_path)
    run_cell(Cell("c", "joint"), **FOLDERS, presets=Path("presets"), root=tmp_path)
    assert scripts[0][1][-2:] == ["--config_path", str(tmp_path / "presets/generalize.yaml")]
    assert "--config_path" not in scripts[1][1]


@pytest.mark.parametrize(("output", "last"), [("a\nerror: b\n", "error: b"), ("", "no output")])
def test_the_message_of_a_failed_cell_is_the_last_line_of_its_output(monkeypatch, tmp_path, output, last):
    def run_script(script, arguments, folder, log):
        log.write_text(output)
        return 2

    monkeypatch.setattr("dynmap_rl.paper.launch.run_script", run_script)
    message = run_cell(CELL, **FOLDERS, root=tmp_path)
    assert message == f"b failed; see runs/b.log, which ends with: {last}"
    assert not is_done("b", tmp_path / "results")


CELLS = [Cell(name, "joint") for name in "abc"]


def fail_at_b(cell):
    return "b failed" if cell.name == "b" else None


def test_cells_that_fail_do_not_stop_the_others(capsys):
    assert launch(CELLS, fail_at_b) == ["b failed"]
    assert capsys.readouterr().out.splitlines() == ["done: a", "done: c"]
    assert launch([], fail_at_b) == []


def test_workers_run_at_the_same_time():
    begun = {cell.name: Event() for cell in CELLS}

    def wait_for_others(cell):
        begun[cell.name].set()
        return None if all(event.wait(20) for event in begun.values()) else "alone"

    assert launch(CELLS, wait_for_others, workers=3) == []


def test_an_interrupt_begins_no_other_cell():
    begun = []

    def interrupt(cell):
        begun.append(cell.name)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        launch(CELLS[:1], interrupt)
    assert begun == ["a"]


def test_launchers_are_checked(monkeypatch):
    check_launcher("local")
    with pytest.raises(ValueError, match="got 'slurm'"):
        launch(CELLS, fail_at_b, "slurm")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ValueError, match=r"pip install '\.\[ray\]'"):
        launch(CELLS, fail_at_b, "ray")


@pytest.mark.slow
def test_ray_reports_a_cell_whose_process_died(monkeypatch):
    ray = pytest.importorskip("ray")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")

    def die_at_b(cell):
        return os._exit(1) if cell.name == "b" else None

    try:
        messages = launch(CELLS, die_at_b, "ray", cpus=1)
    finally:
        ray.shutdown()
    assert messages == ["b: a worker was lost by Ray (WorkerCrashedError); the same command resumes"]
