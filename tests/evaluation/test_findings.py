"""The paper's claims, tested on made-up results."""

import json

import pytest

from dynmap_rl.paper.findings import DROPS
from dynmap_rl.paper.findings import compare_cells
from dynmap_rl.paper.findings import list_pairs
from dynmap_rl.paper.findings import markdown_findings
from dynmap_rl.paper.findings import markdown_spread
from dynmap_rl.paper.findings import spread
from dynmap_rl.paper.published import TABLES

TASK = "balance_reaching"


def write(folder, row, successes, policy="recurrent", training="decoupled", task=TASK, seed=0, count=40):
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
        "settings": {"world_model_seed": seed},
        "test_protocol": {"SR": 100 * successes / count, "DR": 0.0},
        "results": [{"test": {"rows": rows}}] * 3,
    }
    (folder / f"{task}_{training}_{row}_{policy}_{seed}.json").write_text(json.dumps(result))


def test_every_pair_is_of_cells_that_the_paper_has_and_no_two_are_the_same():
    pairs = list(list_pairs())
    for _, _, *keys in pairs:
        for *column, row in keys:
            assert row in TABLES[tuple(column)]
    assert len({(claim, comparison) for claim, comparison, *_ in pairs}) == len(pairs)


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
    text = markdown_findings(tmp_path)
    assert "| task 1, recurrent: RGB+[V] - Only-RGB | 95.0 - 50.0 | +45.0 [" in text
    assert "**Decoupled training beats joint training**" not in text


def test_spread_is_over_the_seeds_of_the_world_model(tmp_path):
    for seed, successes in enumerate((20, 30, 40)):
        write(tmp_path, "Only-RGB", successes, seed=seed)
    write(tmp_path, "RGB+[P]", 40)
    assert compare_cells(tmp_path)[0]["rates"] == [100.0, 50.0]  # of the first seed
    [row] = spread(tmp_path)
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
