"""The grid of MuJoCo tasks: cells, rows and table."""

import pytest
import torch
from own_task import check_renderer

from dynmap_rl.data import load_dataset, record_dataset
from dynmap_rl.evaluation.protocol import pack_rows
from dynmap_rl.evaluation.statistics import welch_interval
from dynmap_rl.paper.benchmarks import (
    COLORS,
    FRAMES,
    METHODS,
    SEEDS,
    TASKS,
    benchmark_page,
    benchmark_rows,
    benchmark_table,
    derive_dataset,
    gap_table,
    list_benchmarks,
)
from dynmap_rl.utils.cli import parse_settings, read_arguments
from dynmap_rl.utils.files import read_json, write_json
from recipes import baseline, decoupled, end_to_end, joint


def make_result(success, first=0):
    values = [
        {"scene_seed": first + i, "success": good, "dropped": False, "touched": False, "position_error": 0.1}
        | ({} if good else {"cause": "overshoots" if i else "stops short"})
        for i, good in enumerate(success)
    ]
    result = {"test": {"rows": pack_rows(values)}}
    summary = {"localization": 10.0 + first}
    return {
        "command": "python recipes/x.py",
        "commit": "abc-dirty",
        "results": [result],
        "test_protocol": summary,
    }


def test_every_cell_is_a_command_that_its_recipe_understands():
    cells, recipes = (
        list_benchmarks(7),
        {"baseline": baseline, "decoupled": decoupled, "end_to_end": end_to_end, "joint": joint},
    )
    rows = len(TASKS) * (len(METHODS) - 1) + len(COLORS)  # one row is of the tasks whose object has a colour
    assert len(cells) == rows * len(SEEDS) == len({cell.name for cell in cells.values()})
    for (task, method, seed), cell in cells.items():
        config = parse_settings(
            recipes[cell.recipe].Config, read_arguments(list(cell.arguments), recipes[cell.recipe].Config)
        )
        assert (config.task, config.seeds, config.eval.episodes) == (
            f"mujoco:{task}{FRAMES.get(method, '')}",
            str(seed),
            7,
        )
        if cell.recipe == "decoupled":
            assert config.world_model.seed == seed


def test_the_table_has_what_the_results_have(tmp_path):
    cells = list_benchmarks()
    for seed, success in ((0, [1, 1, 0, 1]), (1, [1, 0, 0, 1])):
        write_json(tmp_path / f"{cells['Soccer', 'RGB+[P]', seed].name}.json", make_result(success))
    [row] = benchmark_rows(tmp_path)
    assert (row["task"], row["method"], row["seeds"], row["episodes"]) == ("Soccer", "RGB+[P]", 2, 8)
    assert row["SR"] == 62.5 and row["SR_interval"][0] < 62.5 < row["SR_interval"][1]
    table = benchmark_table([row])
    assert "62.5" in table and "2 of 3 seeds" in table and all(method in table for method in METHODS)
    assert row["localization"] == 10 and row["rates"] == [75, 50] and row["causes"] == {"overshoots": 3}
    (tmp_path / "soccer_rgb_p_seed_0.gif").touch()
    expert = {"rates": {"success": 98.0}, "intervals": {"success": [96.0, 99.0]}, "command": "python y.py"}
    write_json(tmp_path / "expert_soccer.json", expert)
    page = benchmark_page([row], tmp_path)
    assert "soccer_rgb_p_seed_0.gif" in page and "2 of `abc-dirty`" in page and "overshoots" in page
    assert "98.0 [96.0, 99.0]" in page and "python y.py" in page
    write_json(tmp_path / f"{cells['Soccer', 'RGB+[P]', 2].name}.json", make_result([1, 1, 1, 1], first=9))
    with pytest.raises(ValueError, match="same scenes"):
        benchmark_rows(tmp_path)


def test_gaps_are_over_trainings(tmp_path):
    cells = list_benchmarks()
    for method, successes in (
        ("RGB+[P]", ([1, 1, 0, 1], [1, 0, 0, 1])),
        ("Only-RGB", ([0, 0, 0, 0], [1, 0, 0, 0])),
    ):
        for seed, success in enumerate(successes):
            write_json(tmp_path / f"{cells['Soccer', method, seed].name}.json", make_result(success))
    low, high = welch_interval([75, 50], [0, 25])
    lines = gap_table(benchmark_rows(tmp_path)).splitlines()
    [line] = [line for line in lines if line.startswith("| RGB+[P] - Only-RGB |")]
    assert f"| +50.0 [{low:+.1f}, {high:+.1f}] |" in line
    assert sum("+50.0" in line for line in lines) == 1, "others have no results"


def test_a_page_without_failures_or_commits(tmp_path):
    result = make_result([1, 1]) | {"commit": None}
    write_json(tmp_path / f"{list_benchmarks()['Soccer', 'ACT', 0].name}.json", result)
    page = benchmark_page(benchmark_rows(tmp_path), tmp_path)
    assert "1 of `None`" in page and "| Soccer: ACT | 0.0 |" in page


def test_dynamics_of_the_hand_are_its_recorded_positions(tmp_path):
    pytest.importorskip("metaworld")
    check_renderer()
    record_dataset(tmp_path / "plate_slide", "mujoco:PlateSlide", episodes=1, eval_episodes=1, workers=1)
    for _ in range(2):  # the second time, it is there
        derive_dataset("PlateSlide", tmp_path / "plate_slide", "RGB+[P+V] of the hand", tmp_path / "hand")
    assert read_json(tmp_path / "hand/meta/dynamics.json")["verdict"] in ("good", "doubtful")
    hand, full = (load_dataset(tmp_path / name, "train") for name in ("hand", "plate_slide"))
    assert hand["dynamics", "position"].shape == (1, 80, 3)
    torch.testing.assert_close(hand["dynamics", "position"], full["dynamics", "position"][..., -3:])
