"""Generated pages: those of the repository are up to date, and their numbers are those of the cells."""

import json
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import FEW, shared_interval
from dynmap_rl.paper import page
from dynmap_rl.paper.benchmarks import benchmark_page, benchmark_rows
from dynmap_rl.paper.cells import list_runs
from dynmap_rl.paper.delays import delay_page, read_delays
from dynmap_rl.paper.page import (
    MARKS,
    markdown_page,
    markdown_runs,
    replace_block,
    write_results_page,
)
from dynmap_rl.paper.source_page import write_source_page
from dynmap_rl.utils.files import read_json

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "recipes/results"


def test_the_readme_of_the_results_is_generated():
    assert (RESULTS / "README.md").read_text() == markdown_page(RESULTS)


def test_the_table_of_the_main_readme_is_generated():
    text = (ROOT / "README.md").read_text()
    assert text == replace_block(text, markdown_runs(RESULTS)) and MARKS[0] in text


@pytest.mark.parametrize("folder", ["benchmarks3d", "delays", "sources_plain"])
def test_the_pages_of_the_other_grids_are_generated(folder, tmp_path):
    results = Path(shutil.copytree(RESULTS / folder, tmp_path / folder))
    if folder == "benchmarks3d":
        text = benchmark_page(benchmark_rows(results), results)
    elif folder == "delays":
        text = delay_page(read_delays(results))
    else:
        text = write_source_page(results, list(TASKS), "plain")[-1].read_text()
    assert text == (RESULTS / folder / "README.md").read_text()


def test_everything_is_described():
    contents = read_json(RESULTS / "contents.json")
    for name in ("measurements", "media"):
        assert set(contents[name]) == {path.name for path in (RESULTS / name).iterdir()}
    assert {path.stem for path in (RESULTS / "cells").glob("*.json")} <= {run.name for run in list_runs()}
    for path in re.findall(r"\]\((\w+/[\w.]+)\)", (RESULTS / "README.md").read_text()):
        assert (RESULTS / path).exists(), path


def test_a_cell_trained_again_is_the_same():
    again = read_json(RESULTS / "measurements/retrained_position_recurrent.json")
    cell = read_json(RESULTS / "cells/balance_reaching_decoupled_position_recurrent.json")
    assert again["world_model_sha256"] == cell["world_model_sha256"] and again["commit"] != cell["commit"]
    assert result_rows(again) == result_rows(cell)


def test_stored_intervals_are_those_of_the_episodes():
    for path in sorted((RESULTS / "cells").glob("*.json"))[::6]:
        result = read_json(path)
        for name, outcome in (("SR_interval", "success"), ("DR_interval", "dropped")):
            rows = result_rows(result)
            count = sum(row[outcome] for seed in rows for row in seed)
            if 0 < min(count, sum(map(len, rows)) - count) < FEW:
                continue  # the rule for so few is younger than the files
            expected = shared_interval(rows, outcome)
            assert result["test_protocol"][name] == pytest.approx(expected), result["command"]


def test_main_cells_and_baselines_are_rows(tmp_path, monkeypatch):
    summary = {"episodes": 3000, "DR": 1.0, "PE": 12.34, "SR": 97.0, "SR_interval": [96.0, 98.0]}
    done = SimpleNamespace(results=[{}], summary=summary | {"world_models": [97.0]})
    cells = {
        ("bin_dropping", "decoupled", "recurrent", "Only-RGB"): done,
        ("bin_dropping", "joint", "recurrent", "Only-RGB"): done,
        ("bin_dropping", "decoupled", "recurrent", "RGB+[A]"): done,
        ("balance_reaching", "decoupled", "recurrent", "RGB+[P+V], plain CNN"): done,
        ("balance_reaching", "decoupled", "recurrent", "RGB+[P+V]"): SimpleNamespace(results=[]),
    }
    monkeypatch.setattr(page, "read_cells", lambda *_: cells)
    rates = {"task": "balance_reaching", "rates": {"dropped": 90.6, "success": 9.4}, "episodes": 1000}
    rates |= {"intervals": {"success": [7.74, 11.36]}}
    (tmp_path / "measurements").mkdir()
    (tmp_path / "measurements/careless_x.json").write_text(json.dumps(rates))
    act = {"policy": "LeRobot", "row": "ACT", "task": "bin_dropping", "test_protocol": summary}
    (tmp_path / "measurements/act_x.json").write_text(json.dumps(act))
    assert markdown_runs(tmp_path).splitlines()[2:] == [
        "| 1 | RGB+[P+V], plain CNN, recurrent | 1 | 3,000 | 1.0 | 12.3 | **97.0** [96.0, 98.0] |",
        "| 1 | careless |  | 1,000 | 90.6 |  | **9.4** [7.7, 11.4] |",
        "| 3 | Only-RGB, recurrent | 1 | 3,000 |  |  | **97.0** [96.0, 98.0] |",
        "| 3 | ACT of LeRobot |  | 3,000 |  |  | **97.0** [96.0, 98.0] |",
    ]


def test_only_the_block_between_the_marks_is_replaced(tmp_path, monkeypatch):
    start, end = MARKS
    text = f"a\n{start}\nold\n{end}\nb\n"
    assert replace_block(text, "new") == f"a\n{start}\nnew\n{end}\nb\n"
    assert replace_block("no marks", "new") == "no marks"
    (tmp_path / "results").symlink_to(RESULTS)
    monkeypatch.setattr(page, "markdown_page", lambda results: (RESULTS / "README.md").read_text())
    (tmp_path / "README.md").write_text(text)
    assert write_results_page(tmp_path / "results", tmp_path / "README.md") == [tmp_path / "README.md"]
    assert write_results_page(tmp_path / "results", tmp_path / "README.md") == []


def test_commands_of_results_name_no_place_of_one_machine():
    files = [*RESULTS.rglob("*.json")]
    named = [str(file) for file in files if re.search(r'"command": "[^"]*[ =]/', file.read_text())]
    assert len(files) > 100 and not named
