"""The paper's claims, tested on made-up results."""

import json

import pytest

from dynmap_rl.paper.findings import (
    DROPS,
    FAILS,
    compare_cells,
    list_pairs,
    markdown_claims,
    markdown_comparisons,
    markdown_spread,
    measure_spread,
)
from dynmap_rl.paper.published import TABLES
from dynmap_rl.paper.results import read_cells

TASK = "balance_reaching"


def write(
    folder,
    row,
    successes,
    policy="recurrent",
    training="decoupled",
    task=TASK,
    seed=0,
    count=40,
    settings=None,
):
    flags = "".join("1" if i < successes else "0" for i in range(count))
    rows = {
        "first_scene_seed": 7,
        "success": flags,
        "dropped": "0" * count,
        "touched": "0" * count,
        "position_error": [0.01] * count,
    }
    result = {
        "row": row,
        "policy": policy,
        "task": task,
        "world_model": {"task": TASK, "training": training},
        "settings": settings or {"world_model_seed": seed},
        "test_protocol": {"SR": 100 * successes / count, "DR": 0.0},
        "results": [{"test": {"rows": rows}}] * 3,
    }
    (folder / f"{task}_{training}_{row}_{policy}_{seed}.json").write_text(json.dumps(result))


def test_every_pair_is_of_cells_that_the_paper_has_and_no_two_are_the_same():
    pairs = list_pairs()
    for *column, row in (key for pair in pairs for key in (pair.a, pair.b)):
        assert row in TABLES[tuple(column)]
    assert len({(pair.claim, pair.comparison) for pair in pairs}) == len(pairs)


def test_cells_that_are_there_are_compared_on_their_start_states(tmp_path):
    write(tmp_path, "Only-RGB", 20)
    write(tmp_path, "RGB+[V]", 38)
    write(tmp_path, "RGB+[V]", 30, policy="feedforward")
    found = {(row["claim"], row["comparison"]): row for row in compare_cells(tmp_path)}
    assert set(found) == {
        ("Dynamics beat Only-RGB", "task 1, recurrent: RGB+[V] - Only-RGB"),
        ("Recurrent policies beat feed-forward ones", "RGB+[V]"),
        (DROPS, "RGB+[V]"),
    }
    better = found["Dynamics beat Only-RGB", "task 1, recurrent: RGB+[V] - Only-RGB"]
    assert better["rates"] == [95.0, 50.0]
    assert better["gap"] == pytest.approx(45.0)
    assert better["interval"][0] > 20 and better["p"] < 0.001 and better["apart"]
    assert better["verdict"] == "agrees" and better["group"] == "without position"
    text = markdown_comparisons(compare_cells(tmp_path))
    assert "| task 1, recurrent: RGB+[V] - Only-RGB | 95.0 - 50.0 | +45.0 [" in text
    assert "**Decoupled training beats joint training**" not in text


def test_spread_is_over_the_seeds_of_the_world_model(tmp_path):
    for seed, successes in enumerate((20, 30, 40)):
        write(tmp_path, "Only-RGB", successes, seed=seed)
    write(tmp_path, "RGB+[P]", 40)
    assert compare_cells(tmp_path)[0]["rates"] == [100.0, 50.0]  # of the first seed
    [row] = measure_spread(tmp_path)
    assert (row["row"], row["SR"], row["mean"]) == ("Only-RGB", [50.0, 75.0, 100.0], 75.0)
    assert row["std"] == pytest.approx(20.4, abs=0.1)
    assert "| Only-RGB | 50.0, 75.0, 100.0 | 75.0 (20.4) |" in markdown_spread(tmp_path)


def test_p_is_adjusted_and_policies_are_apart(tmp_path):
    write(tmp_path, "Only-RGB", 20)
    write(tmp_path, "RGB+[P]", 25)
    alone = compare_cells(tmp_path)[0]
    assert alone["p"] == pytest.approx(2 / 2**5) and alone["apart"]
    write(tmp_path, "RGB+[V]", 20)
    both = {row["comparison"]: row for row in compare_cells(tmp_path)}
    assert both["task 1, recurrent: RGB+[P] - Only-RGB"]["p"] == pytest.approx(2 * 2 / 2**5)
    assert not both["task 1, recurrent: RGB+[V] - Only-RGB"]["apart"]


def test_drops_are_compared_as_drops(tmp_path):
    for policy, dropped in (("recurrent", "0" * 40), ("feedforward", "1" * 10 + "0" * 30)):
        write(tmp_path, "Only-RGB", 20, policy=policy)
        path = tmp_path / f"{TASK}_decoupled_Only-RGB_{policy}_0.json"
        result = json.loads(path.read_text())
        for seed in result["results"]:
            seed["test"]["rows"]["dropped"] = dropped
        path.write_text(json.dumps(result))
    [row] = [row for row in compare_cells(tmp_path) if row["claim"] == DROPS]
    assert row["gap"] == pytest.approx(-25.0)
    assert row["verdict"] == "agrees", "fewer drops are better"


def test_verdicts_are_counted(tmp_path):
    task = "bin_dropping"
    for row, successes in (("Only-RGB", 20), ("RGB+[P]", 40), ("RGB+[V]", 5), ("RGB+[A]", 20)):
        write(tmp_path, row, successes, task=task)
    comparisons = compare_cells(tmp_path)
    verdicts = {
        row["comparison"].split(" - ")[0]: row["verdict"] for row in comparisons if row["claim"] == FAILS
    }
    assert verdicts == {"RGB+[P]": "contradicts", "RGB+[V]": "agrees", "RGB+[A]": "unclear"}
    lines = markdown_claims(comparisons).splitlines()
    assert f"| {FAILS} | without position | 1 | 0 | 1 | -37.5 to +0.0 |" in lines
    assert f"| {FAILS} | with position | 0 | 1 | 0 | +50.0 |" in lines


def test_the_seed_of_the_world_model_is_read_from_settings_of_both_releases(tmp_path):
    write(tmp_path, "RGB+[P]", 10, settings={"world_model": None, "world_model_seed": 1})
    assert not read_cells(tmp_path) and len(read_cells(tmp_path, 1)) == 1
    write(tmp_path, "RGB+[P]", 10, settings={"world_model": {"seed": 2}})
    assert not read_cells(tmp_path, 1) and len(read_cells(tmp_path, 2)) == 1
    write(tmp_path, "RGB+[P]", 10, settings={"world_model": "runs/other"})
    assert len(read_cells(tmp_path)) == 1
