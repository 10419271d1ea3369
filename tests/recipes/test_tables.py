"""The grid of the paper's tables: its cells, its runs, and what is printed of its results."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import commands
import pytest
from filelock import FileLock

from dynmap_rl.paper.cells import list_cells
from dynmap_rl.paper.published import TABLES
from dynmap_rl.modules.supervision import parse_supervision
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.paper.tables import COLUMNS

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


def test_a_table_is_chosen_alone(tmp_path):
    """By the task of its columns, and with the world models of task 1 that tables II and III need."""

    def listed(*arguments):
        lines = run(tmp_path, "--dry_run", *arguments).stdout.splitlines()
        return {line.split()[-1] for line in lines[:-1]}, lines[-1]

    by_name = {cell.name: cell for cell in list_cells()}
    first, said = listed("--table", "I")
    own = {name for name, cell in by_name.items() if cell.task == "balance_reaching"}
    assert first == own and "0 of 35 cells" in said
    assert sum("world_model_" in name for name in first) == 10, "the further world models of the claims"
    for table, columns in COLUMNS.items():
        [task] = {column[0] for column in columns}
        found, said = listed("--table", table)
        cells = {name for name, cell in by_name.items() if cell.task == task}
        needed = {by_name[name].needs for name in cells} - {None}
        assert found == cells | needed
        minutes = sum(by_name[name].minutes for name in found)
        assert said.endswith(f"about {minutes / 60:.1f} hours of one core are left")
    assert listed("--table", "I,II,III") == listed() and len(listed()[0]) == len(by_name)
    two, _ = listed("--table", "II, III", "--only", "joint_none")
    assert two == {f"{task}_joint_none_recurrent" for task in TASKS}
    one, _ = listed("--table", "I", "--only", "joint_none")
    assert one == {"balance_reaching_joint_none_recurrent"}


def done(result):
    """The cells that the recipe says it has run, and then where its page is."""
    *cells, page = result.stdout.splitlines()
    assert page == "written: runs/tables_smoke/report.html"
    return [line.removeprefix("done: ") for line in cells]


def test_cells_run_once_and_are_printed_beside_the_paper(recordings, tmp_path):
    commands.place_recordings(tmp_path, recordings, *TASKS)
    smoke = "--smoke", "--only", "joint_none"
    result = run(tmp_path, *smoke)
    assert result.returncode == 0, result.stderr
    names = [f"{task}_joint_none_recurrent" for task in TASKS]
    assert done(result) == names
    page = (tmp_path / "runs/tables_smoke/report.html").read_text()
    assert "Table III, joint, recurrent" in page and "| Only-RGB | 46 (1.6) | " in page
    assert sorted(p.stem for p in (tmp_path / "results").iterdir()) == sorted(names)

    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()}
    (tmp_path / "results/bin_dropping_joint_none_recurrent.json").unlink()
    again = run(tmp_path, *smoke)
    assert done(again) == ["bin_dropping_joint_none_recurrent"]
    assert all(path.stat().st_mtime_ns == time for path, time in times.items() if "bin" not in path.name)

    said, page = run(tmp_path, *smoke).stdout.splitlines()
    assert said.startswith("nothing to do: 3 cells are in results")
    assert page == "written: runs/tables_smoke/report.html"

    shutil.rmtree(tmp_path / "runs")  # as in a fresh clone, where results are but no runs
    (tmp_path / "results/bin_dropping_joint_none_recurrent.json").unlink()
    fresh = run(tmp_path, "--smoke", "--only", "bin_dropping_joint_none_recurrent")
    assert done(fresh) == [names[0], names[2]], fresh.stderr
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
    for _ in range(3):  # Ray gives its own processes 30 s to start, which a busy machine may need longer for
        result = subprocess.run(command, cwd=tmp_path, env=os.environ, capture_output=True, text=True)
        if "timed out during startup" not in result.stderr:
            break
    names = ["balance_reaching_joint_none_recurrent", "balance_reaching_obstacle_joint_none_recurrent"]
    assert done(result) == names, result.stderr
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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("send", "number"),
    [(os.killpg, signal.SIGINT), (os.kill, signal.SIGKILL)],
    ids=["Ctrl-C", "parent killed"],
)
def test_what_stops_the_command_stops_its_cells_and_begins_no_other(recordings, tmp_path, send, number):
    """Ctrl-C, which a terminal sends to all processes, and a kill of the first one alone."""
    commands.place_recordings(tmp_path, recordings, TASKS[0])
    first, second = (
        tmp_path / f"runs/tables_smoke/balance_reaching_joint_{row}_recurrent"
        for row in ("velocity", "velocity_acceleration")
    )
    smoke = "--smoke", "--results", "results", "--only"
    command = [sys.executable, str(RECIPE), *smoke, "balance_reaching_joint_velocity"]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # which tests in the background do not
    with subprocess.Popen(command, cwd=tmp_path, start_new_session=True, preexec_fn=heed) as process:
        while not (first / "config.json").exists():
            assert process.poll() is None
            time.sleep(0.02)
        send(process.pid, number)
    assert process.returncode == (1 if number == signal.SIGINT else -number)
    with FileLock(first / ".lock", timeout=60):
        assert not (first / "eval.json").exists() and not second.exists()
    again = commands.run(tmp_path, "tables", *smoke, first.name)
    assert done(again) == [first.name], again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nothing"], "no cell's name holds"),
        (["--table", "II", "--only", "balance_reaching_joint"], "no cell's name holds"),
        (["--table", "I,IV"], "--table is I, II or III, or several with commas between, not 'I,IV'"),
        (["--print", "html"], "markdown, json or findings"),
        (["--launcher", "slurm"], "local or ray"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
