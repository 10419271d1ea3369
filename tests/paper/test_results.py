"""Cells, merged from the results of their runs."""

import json

import pytest
from made_up import TASK, flags, write
from scipy.stats import t

from dynmap_rl.evaluation.statistics import shared_interval
from dynmap_rl.paper.results import count_commits, find_repeated, read_cells
from dynmap_rl.utils.files import write_json

KEY = TASK, "decoupled", "recurrent", "RGB+[P]"


def test_a_cell_merges_the_runs_that_are_there(tmp_path):
    assert not read_cells(tmp_path)[KEY].results and read_cells(tmp_path)[KEY].missing == 3
    write(tmp_path, "RGB+[P]", 40, 30)
    cell = read_cells(tmp_path)[KEY]
    assert (len(cell.results), cell.missing, len(cell.policies)) == (2, 1, 6)
    assert cell.rates() == [100.0, 75.0] and cell.summary["SR"] == 87.5
    assert cell.summary["episodes"] == 6 * 40
    assert cell.protocol["SR"] == (87.5, 12.5)
    assert cell.summary["DR_interval"] == shared_interval(cell.policies, "dropped")
    low, high = cell.summary["SR_interval"]
    assert low < 87.5 < high


def test_the_interval_over_world_models_is_students(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 24, 28)
    summary = read_cells(tmp_path)[KEY].summary
    half = t.ppf(0.975, 2) * 10 / 3**0.5
    assert summary["world_model_interval"] == pytest.approx((60 - half, 60 + half))
    write(tmp_path / "one", "RGB+[P]", 20)
    assert read_cells(tmp_path / "one")[KEY].summary["world_model_interval"] is None


def test_results_on_other_scenes_are_refused(tmp_path):
    write(tmp_path, "RGB+[P]", 40, 30)
    path = sorted(tmp_path.glob("*.json"))[1]
    result = json.loads(path.read_text())
    for scenes in (
        {"first_scene_seed": 9},
        {name: flags(1, 30) for name in ("success", "dropped", "touched")},
    ):
        rows = [seed["test"]["rows"] | scenes for seed in result["results"]]
        write_json(path, result | {"results": [{"test": {"rows": row}} for row in rows]})
        with pytest.raises(ValueError, match=f"{path.name} must have the same scenes as"):
            read_cells(tmp_path)


def test_every_seed_of_joint_training_has_a_world_model(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 30, 40, training="joint")
    cell = read_cells(tmp_path)[TASK, "joint", "recurrent", "RGB+[P]"]
    assert cell.rates() == [50.0, 75.0, 100.0] and not cell.missing


def test_world_models_that_agree_have_no_interval(tmp_path):
    write(tmp_path, "RGB+[P]", 40, 40, 40)
    assert read_cells(tmp_path)[KEY].summary["world_model_interval"] is None


def test_commits_are_counted_by_run(tmp_path):
    write(tmp_path, "RGB+[P]", 40, 30, commit="abc")
    write(tmp_path, "RGB+[V]", 40, commit="def")
    assert count_commits(read_cells(tmp_path).values()) == {"abc": 2, "def": 1}


def test_runs_on_another_training_of_a_world_model_are_named(tmp_path):
    write(tmp_path, "RGB+[P]", 40, 40)
    for task, successes in (("bin_dropping", (20, 20)), ("balance_reaching_obstacle", (20,))):
        write(tmp_path, "RGB+[P]", *successes, task=task)
    assert find_repeated(tmp_path) == []
    path = tmp_path / "bin_dropping_decoupled_position_recurrent_world_model_1.json"
    path.write_text(path.read_text().replace('"decoupled RGB+[P] 1"', '"another"'))
    assert find_repeated(tmp_path) == [path.stem]


def test_rows_that_the_paper_lacks_are_of_other_tables(tmp_path):
    row = "RGB+[P+V], plain CNN"
    write(tmp_path, row, 40)
    assert (TASK, "decoupled", "recurrent", row) not in read_cells(tmp_path)
    cell = read_cells(tmp_path, ["extra"])[TASK, "decoupled", "recurrent", row]
    assert cell.published is None and cell.summary["SR"] == 100.0
    assert read_cells(tmp_path)[KEY].published["SR"] == (92, 4.3)
