"""The grid of the paper's tables: its cells, its runs, and what is printed of its results."""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import commands
import pytest

from dynmap_rl.cells import list_cells
from dynmap_rl.evaluation.paper import TABLES, parse_supervision, row_name

RECIPE = Path(__file__).parents[2] / "recipes" / "tables.py"


TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"


def run(folder, *arguments):
    return commands.run(folder, "tables", "--results", "results", *arguments)


def test_there_is_a_cell_for_every_one_of_the_paper():
    cells = list_cells()
    assert len({cell.name for cell in cells}) == len(cells)
    by_name = {cell.name: cell for cell in cells}
    expected = {(*column, row) for column, rows in TABLES.items() for row in rows}
    found = set()
    for cell in cells:
        if "world_model_" in cell.name:
            continue
        source = by_name[cell.needs] if cell.needs else cell
        options = dict(zip(source.arguments[::2], source.arguments[1::2], strict=True))
        supervision = parse_supervision(options.get("--supervision", "none"))
        own = dict(zip(cell.arguments[::2], cell.arguments[1::2], strict=True))
        training = "decoupled" if source.recipe == "decoupled" else "joint"
        row = row_name(supervision, source.recipe)
        task = own.get("--task", "balance_reaching")
        found.add((task, training, own.get("--policy", "recurrent"), row))
    assert found == expected


def test_cells_run_once_and_are_printed_beside_the_paper(recordings, tmp_path):
    commands.place_recordings(tmp_path, recordings, *TASKS)
    smoke = "--smoke", "--only", "joint_none"
    result = run(tmp_path, *smoke)
    assert result.returncode == 0, result.stderr
    names = [f"{task}_joint_none_recurrent" for task in TASKS]
    assert [line.removeprefix("done: ") for line in result.stdout.splitlines()] == names
    assert sorted(p.stem for p in (tmp_path / "results").iterdir()) == sorted(names)

    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()}
    (tmp_path / "results/bin_dropping_joint_none_recurrent.json").unlink()
    again = run(tmp_path, *smoke)
    assert again.stdout == "done: bin_dropping_joint_none_recurrent\n"
    assert all(path.stat().st_mtime_ns == time for path, time in times.items() if "bin" not in path.name)

    assert run(tmp_path, *smoke).stdout.startswith("nothing to do: 3 cells are in results")

    shutil.rmtree(tmp_path / "runs")  # as in a fresh clone, where results are but no runs
    (tmp_path / "results/bin_dropping_joint_none_recurrent.json").unlink()
    fresh = run(tmp_path, "--smoke", "--only", "bin_dropping_joint_none_recurrent")
    assert fresh.stdout.splitlines() == [f"done: {names[0]}", f"done: {names[2]}"], fresh.stderr
    assert all(path.stat().st_mtime_ns == time for path, time in times.items() if "bin" not in path.name)

    rows = json.loads(run(tmp_path, "--print", "json").stdout)
    assert [(r["table"], r["row"], r["column"], r["n"]) for r in rows] == [
        (table, "Only-RGB", "joint, recurrent", 3) for table in ("I", "II", "III")
    ]
    assert rows[2]["paper"]["SR"] == [46, 1.6]
    text = run(tmp_path, "--print", "markdown").stdout
    assert "| Only-RGB | 64 (5.9); 17, 92 |" in text
    assert re.search(r"^\| Only-RGB \| 21 / - \| 73 / - \| 64 / \*\*\d", text, re.M)
    dry = run(tmp_path, "--dry_run").stdout
    assert dry.count("   done  ") == 3 and "3 of 69 cells are done" in dry


def test_ray_runs_the_same_cells(recordings, tmp_path, monkeypatch):
    pytest.importorskip("ray")
    commands.place_recordings(tmp_path, recordings, *TASKS[:2])
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    (tmp_path / "runs/tables_smoke/bin_dropping_joint_none_recurrent").mkdir(parents=True)
    (tmp_path / "runs/tables_smoke/bin_dropping_joint_none_recurrent/config.json").write_text("{}")
    command = [sys.executable, str(RECIPE), "--results", "results", "--smoke", "--only", "joint_none"]
    command += ["--launcher", "ray", "--cpus", "1"]
    result = subprocess.run(command, cwd=tmp_path, env=os.environ, capture_output=True, text=True)
    names = ["balance_reaching_joint_none_recurrent", "balance_reaching_obstacle_joint_none_recurrent"]
    assert [line.removeprefix("done: ") for line in result.stdout.splitlines()] == names, result.stderr
    assert sorted(p.stem for p in (tmp_path / "results").iterdir()) == sorted(names)
    assert result.returncode == 2
    assert "bin_dropping_joint_none_recurrent failed; see runs/tables_smoke/" in result.stderr


def test_a_cell_that_fails_says_where_to_look_and_the_others_go_on(tmp_path):
    (tmp_path / "runs/tables_smoke/balance_reaching_joint_none_recurrent").mkdir(parents=True)
    (tmp_path / "runs/tables_smoke/balance_reaching_joint_none_recurrent/config.json").write_text("{}")
    result = run(tmp_path, "--smoke", "--only", "joint_none")
    assert result.returncode == 2
    assert "balance_reaching_joint_none_recurrent failed; see runs/tables_smoke/" in result.stderr
    assert "bin_dropping_joint_none_recurrent waits for its world model" in result.stderr
    assert "joint_none_recurrent.log, which ends with: error: " in result.stderr
    assert "holds a run with other settings" in result.stderr


def test_ctrl_c_begins_no_other_cell(monkeypatch):
    begun = []

    def run_cell(cell, config, root):
        begun.append(cell)
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGINT)  # as a terminal sends it to all of its processes
        time.sleep(0.2)

    recipe = importlib.import_module("recipes.tables")
    monkeypatch.setattr(recipe, "run_cell", run_cell)
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            recipe.launch(list_cells(), recipe.Config())
    finally:
        signal.signal(signal.SIGINT, previous)
    assert len(begun) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nothing"], "no cell's name holds"),
        (["--print", "html"], "markdown, json or findings"),
        (["--launcher", "slurm"], "local or ray"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
