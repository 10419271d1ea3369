"""The grid of the paper's tables: choice of the runs, their results, and the printed tables."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import commands
import pytest
from filelock import FileLock

from dynmap_rl.paper.cells import list_runs
from recipes.paper import tables

RECIPE = Path(tables.__file__)
TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
NAMES = [f"{task}_joint_none_recurrent" for task in TASKS]
ALL = [run.name for run in list_runs() if "_joint_none_" in run.name]  # in the order of the grid
SMALL = "--results", "results", "--presets", str(commands.PRESETS)


def run(folder, *arguments):
    return commands.run(folder, "tables", *SMALL, *arguments)


def done(result) -> list[str]:
    """Runs that the recipe has executed."""
    lines = result.stdout.splitlines()
    return [line.removeprefix("done: ") for line in lines if line.startswith("done: ")]


def listed(folder, *arguments):
    lines = run(folder, "--dry_run", *arguments).stdout.splitlines()
    return {line.split()[-1] for line in lines[:-1]}, lines[-1]


def test_a_table_is_chosen_with_the_world_models_that_it_needs(tmp_path):
    by_name = {run.name: run for run in list_runs()}
    for table, task in zip(("I", "II", "III"), TASKS, strict=True):
        found, said = listed(tmp_path, "--table", table)
        runs = {name for name, run in by_name.items() if run.table == table}
        assert {by_name[name].task for name in runs} == {task}
        assert found == runs | ({by_name[name].needed_run for name in runs} - {None})
        assert f"about {sum(by_name[name].minutes for name in found) / 60:.1f} hours" in said
    assert listed(tmp_path)[0] == set(by_name)
    assert listed(tmp_path, "--table", "II,III", "--only", "joint_none")[0] == set(ALL)
    assert listed(tmp_path, "--table", "I", "--only", "joint_none")[0] == set(NAMES[:1])
    found = listed(tmp_path, "--table", "extra", "--only", "plain_none_feedforward")[0]
    assert found == {f"balance_reaching_plain_none_{kind}{seed}" for kind in ("recurrent", "feedforward")
                     for seed in ("", "_world_model_1", "_world_model_2")}  # fmt: skip


def fake_script(calls):
    """Return a stand-in for ``run_script`` that keeps the arguments and writes a result."""

    def run_script(script, arguments, folder, log):
        given = dict(zip(arguments[::2], arguments[1::2], strict=True))
        calls.append((script.stem, given))
        log.write_text("error: no luck\n")
        if "unlucky" in os.environ.get("RUNS", "") and given["--run"].endswith(NAMES[0]):
            return 2
        task = given.get("--task", TASKS[0])
        run, flags = folder / given["--run"], {"success": "110", "dropped": "000", "touched": "000"}
        rows = flags | {"first_scene_seed": 0, "position_error": [0.01] * 3}
        metrics = {"DR": 0.0, "PE": 10.0, "SR": 66.7}
        run.mkdir(parents=True)
        (run / "eval.json").write_text(json.dumps({
            "task": task, "policy": "recurrent", "row": "Only-RGB", "settings": {"world_model": {"seed": 0}},
            "world_model": {"task": TASKS[0], "training": "joint"},
            "results": [{"test": {"rows": rows}, "paper": {"rows": rows}, "world_model_sha256": "0"}],
            "test_protocol": metrics | {"episodes": 3}, "paper_protocol": {k: (v, 0.0) for k, v in metrics.items()},
            "seeds": [0], "command": "python x.py", "world_model_sha256": None if script.stem == "joint" else "0",
        }))  # fmt: skip
        return 0

    return run_script


@pytest.fixture
def calls(monkeypatch, recordings, tmp_path):
    """Calls of the cells' recipes, which are not run."""
    calls = []
    monkeypatch.setattr("dynmap_rl.paper.launch.run_script", fake_script(calls))
    monkeypatch.setattr("dynmap_rl.training.dataset.find_or_record", lambda task, dataset=None: None)
    return calls


def test_cells_run_once_and_are_printed_beside_the_paper(calls, tmp_path):
    result = run(tmp_path, "--only", "joint_none")
    assert result.returncode == 0, result.stderr
    assert done(result) == ALL and ALL[:3] == NAMES
    assert [recipe for recipe, _ in calls] == ["joint"] + ["generalize"] * 6
    source = f"runs/tables/{NAMES[0]}"
    expected = [source, source, *[f"{source}/seed_1"] * 2, *[f"{source}/seed_2"] * 2]
    assert [given["--pretrained"] for _, given in calls[1:]] == expected
    assert {given["--compute.threads"] for _, given in calls} == {"2"}
    assert calls[0][1]["--config_path"] == str(commands.PRESETS / "joint.yaml")
    assert (
        "| Only-RGB | 46 (1.6) | 67 (0.0) | **66.7** [" in (tmp_path / "runs/tables/report.html").read_text()
    )
    assert sorted(path.stem for path in (tmp_path / "results").iterdir()) == sorted(ALL)

    rows = json.loads(run(tmp_path, "--print", "json").stdout)
    assert [(r["table"], r["row"], r["column"], r["n"]) for r in rows] == [
        (table, "Only-RGB", "joint, recurrent", 3 if table == "I" else 9) for table in ("I", "II", "III")
    ]
    assert "| Only-RGB | 64 (5.9); 17, 92 | 67 (0.0); 0, 10 |" in run(tmp_path, "--print", "markdown").stdout
    assert run(tmp_path, "--print", "findings").returncode == 0
    assert run(tmp_path, "--dry_run").stdout.count("   done  ") == len(ALL)


def test_only_cells_without_a_result_run_and_the_world_models_that_they_need(calls, tmp_path):
    run(tmp_path, "--only", "joint_none")
    (tmp_path / f"results/{NAMES[2]}.json").unlink()
    (tmp_path / f"runs/tables/{NAMES[2]}").rename(tmp_path / "old")
    assert done(run(tmp_path, "--only", "joint_none")) == NAMES[2:3]
    assert done(run(tmp_path, "--only", "joint_none")) == []
    (tmp_path / "runs").rename(tmp_path / "runs_of_old")  # results are there, but no runs
    (tmp_path / f"results/{NAMES[2]}.json").unlink()
    assert done(run(tmp_path, "--only", NAMES[2])) == [NAMES[0], NAMES[2]]


def test_a_failed_cell_is_reported_with_those_that_need_it(calls, tmp_path, monkeypatch):
    monkeypatch.setenv("RUNS", "unlucky")
    result = run(tmp_path, "--only", "joint_none", "--workers", "2")
    assert result.returncode == 2 and calls[0][1]["--compute.threads"] == "1"
    message = f"{NAMES[0]} failed; see runs/tables/{NAMES[0]}.log, which ends with: error: no luck"
    assert message in result.stderr and len(calls) == 1
    assert NAMES[2] in result.stderr and len(result.stderr.splitlines()) == 1


@pytest.mark.slow
def test_real_cells(recordings, tmp_path):
    commands.place_recordings(tmp_path, recordings, *TASKS)
    for name in NAMES[1:]:
        result = run(tmp_path, "--only", name)
        assert done(result)[-1] == name, result.stderr
    rows = json.loads(run(tmp_path, "--print", "json").stdout)
    assert [row["n"] for row in rows] == [3, 3, 3]  # with the run whose world model they need


@pytest.mark.slow
def test_ray_runs_the_same_cells(ray, recordings, tmp_path):
    commands.place_recordings(tmp_path, recordings, *TASKS[:2])
    other = tmp_path / "runs/tables" / NAMES[2]
    other.mkdir(parents=True)
    for name in ("config.json", "metrics.jsonl"):  # a run of another release: the cell fails
        (other / name).write_text("{}")
    (tmp_path / "datasets/bin_dropping").symlink_to(recordings(TASKS[2]), target_is_directory=True)
    command = [
        sys.executable,
        str(RECIPE),
        *SMALL,
        "--only",
        "joint_none",
        "--launcher",
        "ray",
        "--cpus",
        "1",
    ]
    for _ in range(3):  # Ray allows its processes 30 s to start, which a busy machine may exceed
        result = subprocess.run(command, cwd=tmp_path, env=os.environ, capture_output=True, text=True)
        if "timed out during startup" not in result.stderr:
            break
    assert sorted(done(result)) == NAMES[:2], result.stderr
    assert sorted(path.stem for path in (tmp_path / "results").iterdir()) == NAMES[:2]
    assert result.returncode == 2 and f"{NAMES[2]} failed" in result.stderr


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
        tmp_path / f"runs/tables/balance_reaching_joint_{row}_recurrent"
        for row in ("velocity", "velocity_acceleration")
    )
    command = [sys.executable, str(RECIPE), *SMALL, "--only", "balance_reaching_joint_velocity"]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # tests in the background ignore it
    with subprocess.Popen(command, cwd=tmp_path, start_new_session=True, preexec_fn=heed) as process:
        while not (first / "config.json").exists():
            assert process.poll() is None
            time.sleep(0.02)
        send(process.pid, number)
    assert process.returncode == (1 if number == signal.SIGINT else -number)
    with FileLock(first / ".lock", timeout=60):
        assert not (first / "eval.json").exists() and not second.exists()
    again = run(tmp_path, "--only", first.name)
    assert done(again) == [first.name], again.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nothing"], "'nothing'"),
        (["--table", "II", "--only", "balance_reaching_joint"], "'balance_reaching_joint'"),
        (["--table", "I,IV"], "'I,IV'"),
        (["--print", "html"], "'html'"),
        (["--launcher", "slurm"], "'slurm'"),
        (["--cpus", "4"], "--cpus"),
        (["--write"], "--results"),
        (["--workers", "0"], "workers"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
