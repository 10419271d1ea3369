"""Baselines of LeRobot and the grid of MuJoCo tasks, in a small size: cells, resuming, table."""

import pytest
from commands import PRESETS, run
from own_task import check_renderer

from dynmap_rl.paper.benchmarks import benchmark_rows
from dynmap_rl.utils.files import read_json, write_json


def test_the_cells_are_listed_without_work(tmp_path):
    listed = run(tmp_path, "benchmarks3d", "--dry_run", "--results", "found", "--only", "soccer")
    assert listed.returncode == 0, listed.stderr
    assert len(listed.stdout.splitlines()) == 13 * 3 + 1 and "0 of 39 runs" in listed.stdout
    assert not (tmp_path / "found").exists()


@pytest.mark.parametrize(
    ("recipe", "arguments", "message"),
    [
        ("benchmarks3d", ["--only", "chess"], "chess"),
        ("benchmarks3d", ["--write", "--results", "nothing"], "must have results"),
        ("benchmarks3d", ["--presets", "nothing"], "must be a folder"),
        ("baseline", ["--policy", "vqbet"], "vqbet"),
    ],
)
def test_wrong_options_are_refused(tmp_path, recipe, arguments, message):
    result = run(tmp_path, recipe, *arguments)
    assert result.returncode in (1, 2) and message in result.stderr, result.stderr


def test_results_of_other_scenes_are_not_mixed(tmp_path):
    write_json(tmp_path / "found/soccer_act_seed_1.json", {"test_protocol": {"episodes": 500}})
    grid = "benchmarks3d", "--dry_run", "--results", "found", "--only", "soccer_act"
    assert "1 of 3 runs" in run(tmp_path, *grid).stdout
    refused = run(tmp_path, *grid, "--episodes", "20")
    assert refused.returncode == 2 and "500 --episodes instead of 20" in refused.stderr


@pytest.mark.slow
def test_a_cell_is_trained_judged_and_tabled_once(tmp_path):
    check_renderer()
    for package in ("metaworld", "accelerate", "diffusers"):
        pytest.importorskip(package)
    sizes = "--episodes", "2", "--eval_episodes", "1", "--workers", "1"
    assert run(tmp_path, "collect", "--task", "mujoco:PlateSlide", *sizes).returncode == 0
    grid = "benchmarks3d", "--results", "found", "--episodes", "2", "--presets", PRESETS, "--only"
    for cell in ("rgb_p_v_seed_0", "act_seed_1", "diffusion_policy_seed_1"):
        done = run(tmp_path, *grid, f"plateslide_{cell}")
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "found/plateslide_rgb_p_v_seed_0.gif").exists()
    result = read_json(tmp_path / "found/plateslide_act_seed_1.json")
    assert (result["row"], result["seeds"], result["test_protocol"]["episodes"]) == ("ACT", [1], 2)
    assert [(row["task"], row["method"]) for row in benchmark_rows(tmp_path / "found")] == [
        ("PlateSlide", "RGB+[P+V]"),
        ("PlateSlide", "ACT"),
        ("PlateSlide", "Diffusion Policy"),
    ]
    assert (tmp_path / "found/README.md").exists()
    page = (tmp_path / "runs/benchmarks3d/plateslide_act_seed_1/report.html").read_text()
    assert "data:image/gif" in page
    before = (tmp_path / "found/plateslide_act_seed_1.json").stat().st_mtime_ns
    again = run(tmp_path, *grid, "plateslide_act_seed_1")
    assert again.returncode == 0
    assert (tmp_path / "found/plateslide_act_seed_1.json").stat().st_mtime_ns == before
