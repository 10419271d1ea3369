"""The grid of MuJoCo tasks: cells, rows and table."""

import pytest

from dynmap_rl.evaluation.protocol import pack_rows
from dynmap_rl.paper.benchmarks import (
    METHODS,
    SEEDS,
    TASKS,
    benchmark_page,
    benchmark_rows,
    benchmark_table,
    failure_table,
    list_benchmarks,
)
from dynmap_rl.utils.cli import parse_settings, read_arguments
from dynmap_rl.utils.files import write_json
from recipes import baseline, decoupled, end_to_end


def make_result(success, first=0):
    values = [
        {"scene_seed": first + i, "success": good, "dropped": False, "touched": False, "position_error": 0.1}
        | ({} if good else {"cause": "overshoots" if i else "stops short"})
        for i, good in enumerate(success)
    ]
    result = {"test": {"rows": pack_rows(values)}}
    return {"command": "python recipes/x.py", "commit": "0123456789abcdef", "results": [result]}


def test_every_cell_is_a_command_that_its_recipe_understands():
    cells, recipes = (
        list_benchmarks(7),
        {"baseline": baseline, "decoupled": decoupled, "end_to_end": end_to_end},
    )
    assert len(cells) == len(TASKS) * len(METHODS) * len(SEEDS) == len({cell.name for cell in cells.values()})
    for (task, _, seed), cell in cells.items():
        config = parse_settings(
            recipes[cell.recipe].Config, read_arguments(list(cell.arguments), recipes[cell.recipe].Config)
        )
        assert (config.task, config.seeds, config.eval.episodes) == (f"mujoco:{task}", str(seed), 7)
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
    assert row["rates"] == [75, 50] and row["causes"] == {"overshoots": 3}
    assert "37.5" in failure_table([row]) and "stops short" not in failure_table([row])
    (tmp_path / "soccer_rgb_p_seed_0.gif").touch()
    page = benchmark_page([row], tmp_path)
    assert "soccer_rgb_p_seed_0.gif" in page and "2 of `0123456789ab`" in page
    write_json(tmp_path / f"{cells['Soccer', 'RGB+[P]', 2].name}.json", make_result([1, 1, 1, 1], first=9))
    with pytest.raises(ValueError, match="same scenes"):
        benchmark_rows(tmp_path)
