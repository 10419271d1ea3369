"""The grid of sources: choice of the cells, resuming, page and figures; and real cells in a small size."""

import json

import commands
import pytest

from dynmap_rl.paper.sources import SIZES, SOURCES
from dynmap_rl.utils.files import read_json, write_json

TASK = "balance_reaching"
SMALL = "--results", "results", "--presets", str(commands.PRESETS)


def run(folder, *arguments):
    return commands.run(folder, "sources", *SMALL, *arguments)


def listed(folder, *arguments):
    lines = run(folder, "--dry_run", *arguments).stdout.splitlines()
    return [line.split()[-1] for line in lines[:-1]], lines[-1]


def fake_script(calls):
    """Return a stand-in for ``run_script`` that keeps the arguments and writes a result."""

    def run_script(script, arguments, folder, log):
        given = dict(zip(arguments[::2], arguments[1::2], strict=True))
        calls.append((script.stem, given))
        rows = {"success": "110", "dropped": "000", "touched": "000", "first_scene_seed": 0}
        result = {
            "results": [{"test": {"rows": rows | {"position_error": [0.01] * 3}}}],
            "command": "python x.py",
            "commit": "0" * 12,
        }
        write_json(folder / given["--run"] / "eval.json", result)
        return 0

    return run_script


@pytest.fixture
def calls(monkeypatch):
    """Calls of the cells' recipes, which are not run."""
    calls = []
    monkeypatch.setattr("dynmap_rl.paper.launch.run_script", fake_script(calls))
    monkeypatch.setattr("dynmap_rl.paper.sources.make_datasets", lambda *arguments, **options: None)
    monkeypatch.setattr("recipes.paper.sources.measure", lambda config, cells: None)
    return calls


def test_every_source_has_three_world_models_and_two_policies(tmp_path):
    names, said = listed(tmp_path, "--part", "table")
    assert len(names) == len(set(names)) == 6 * len(SOURCES) and "hours of one core" in said
    assert sum(name.endswith("feedforward") for name in names) == 3 * len(SOURCES)
    data, _ = listed(tmp_path, "--part", "data")
    assert len(data) == len(SIZES) * (3 * 5 + 1)
    both, _ = listed(tmp_path)
    assert set(both) == {*names, *data} and len(set(names) & set(data)) == 9, "those of 300 demonstrations"
    assert {name for name in names if "reaching_tracks_" in name} == set(
        listed(tmp_path, "--part", "table", "--only", "tracks")[0]
    )
    first, _ = listed(tmp_path, "--world_models", "0", "--part", "table")
    assert set(first) == {name for name in names if "_world_model_0_" in name}


def test_cells_run_once_and_make_a_page(calls, tmp_path):
    checks = {"jumps": {"good": True}, "residual": {"good": False}}
    judged = {"verdict": "doubtful", "checks": checks}
    write_json(tmp_path / f"datasets/sources/{TASK}_tracks/meta/dynamics.json", judged)
    result = run(tmp_path, "--only", "tracks,none,simulator,end_to_end")
    assert result.returncode == 0, result.stderr
    recipes = [recipe for recipe, _ in calls]
    assert recipes.count("end_to_end") == 4 and recipes.count("decoupled") == 9 * 4 + 9
    by_run = {given["--run"].rpartition("/")[2]: given for _, given in calls}
    tracked = by_run[f"{TASK}_tracks_1000_demonstrations_world_model_2_recurrent"]
    assert tracked["--dataset"].endswith(f"{TASK}_1000_tracks") and tracked["--world_model.seed"] == "2"
    reused = by_run[f"{TASK}_tracks_world_model_1_feedforward"]
    assert reused["--pretrained"].endswith(f"{TASK}_tracks_world_model_1_recurrent")
    assert "--world_model.seed" not in reused and reused["--world_model.supervision"] == "position,velocity"
    page = (tmp_path / "results/README.md").read_text()
    assert "frames: tracks" in page and "| RGB+[P+V], tracked | **66.7**" in page
    assert "doubtful (residual)" in page
    for name in (f"{TASK}_sources", "data"):
        assert (tmp_path / f"results/{name}.png").exists() and f"({name}.png)" in page
    assert not (tmp_path / f"results/{TASK}_measures.png").exists(), "of world models that are not measured"
    calls.clear()
    assert run(tmp_path, "--only", "tracks,none,simulator,end_to_end").returncode == 0 and calls == []
    (tmp_path / f"results/{TASK}_tracks_world_model_1_feedforward.json").unlink()
    run(tmp_path, "--only", "tracks")
    assert len(calls) == 1


def test_cells_of_the_plain_architecture_differ_in_the_training_of_their_world_models_alone(calls, tmp_path):
    only = "--part", "table", "--only", "tracks", "--world_models", "0"
    for form in ("glimpse", "plain"):
        assert run(tmp_path, *only, "--architecture", form, "--runs", form, "--results", form).returncode == 0
    default, plain = calls[:2], calls[2:]
    extra = [
        set(b.items()) - set(a.items()) - {("--run", b["--run"])}
        for (_, a), (_, b) in zip(default, plain, strict=True)
    ]
    assert extra[0] == {("--world_model.architecture", "plain")}
    assert {name for name, _ in extra[1]} == {"--pretrained"}
    calls.clear()
    assert run(tmp_path, "--part", "data", "--only", "end_to_end", "--architecture", "plain").returncode == 0
    assert len(calls) == len(SIZES) and {given["--world_model.architecture"] for _, given in calls} == {
        "plain"
    }


def test_runs_of_the_tables_are_not_repeated(calls, tmp_path):
    rows = {"success": "1", "dropped": "0", "touched": "0", "first_scene_seed": 0, "position_error": [0.01]}
    for policy in ("recurrent", "feedforward"):
        result = {"results": [{"test": {"rows": rows}}], "command": policy, "commit": "0" * 12}
        write_json(tmp_path / f"cells/{TASK}_plain_none_{policy}_world_model_1.json", result)
    only = "--part", "table", "--only", "none", "--world_models", "1", "--tables", "cells"
    plain = run(tmp_path, *only, "--architecture", "plain", "--dry_run").stdout
    assert plain.splitlines()[-1].startswith("2 of 2") and not (tmp_path / "results").exists()
    assert run(tmp_path, *only, "--dry_run").stdout.splitlines()[-1].startswith("0 of 2")
    assert run(tmp_path, *only, "--architecture", "plain").returncode == 0 and calls == []
    for policy in ("recurrent", "feedforward"):
        copied = read_json(tmp_path / f"results/{TASK}_none_world_model_1_{policy}.json")
        assert copied["command"] == policy


def test_a_task_in_space_has_the_sources_without_columns_of_their_own(calls, tmp_path):
    pytest.importorskip("metaworld")
    task = "--tasks", "mujoco:PlateSlide", "--part", "table", "--world_models", "0", "--only", "none,tracks"
    result = run(tmp_path, *task)
    assert result.returncode == 0, result.stderr
    assert len(calls) == 2 and "mujoco:PlateSlide" in (tmp_path / "results/README.md").read_text()
    assert (tmp_path / "results/plate_slide_sources.png").exists()


@pytest.mark.slow
def test_real_cells(recordings, tmp_path):
    """A source of columns of its own, with fewer entries than the task has, trains, is evaluated and measured."""
    commands.place_recordings(tmp_path, recordings, TASK)
    only = "--world_models", "0", "--only", "command,tracks,labelled_50,informed"
    result = run(tmp_path, "--part", "table", *only, "--workers", "2")
    assert result.returncode == 0, result.stderr
    results = {p.stem: read_json(p) for p in (tmp_path / "results").glob("*.json")}
    assert len(results) == 8 and all(r["test_protocol"]["episodes"] == 3 for r in results.values())
    measured = [json.loads(p.read_text()) for p in (tmp_path / "results/measures").glob("*.json")]
    assert len(measured) == 4 and all(m["open_loop_mm"] > 0 for m in measured)
    derived = read_json(tmp_path / f"datasets/sources/{TASK}_tracks/meta/dynamics.json")
    assert derived["verdict"] in ("good", "doubtful")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "radar"], "'radar'|radar"),
        (["--part", "half"], "'half'"),
        (["--part", "data", "--only", "flow"], "no runs"),
        (["--architecture", "vit"], "'vit'"),
        (["--world_models", "0,3"], "0,3"),
        (["--write"], "results must have results"),
        (["--tasks", "nothing", "--dry_run"], "nothing"),
        (["--workers", "0"], "workers"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert message.split("|")[-1] in result.stderr and "Traceback" not in result.stderr
