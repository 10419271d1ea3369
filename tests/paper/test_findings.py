"""The paper's claims, tested on made-up results."""

import json

import pytest
from made_up import flags, write
from scipy.stats import ttest_ind, ttest_rel

from dynmap_rl.paper.claims import list_pairs
from dynmap_rl.paper.findings import (
    FAILED,
    HOLDS,
    MIXED,
    OPEN,
    compare_cells,
    judge_claim,
    markdown_claims,
    markdown_comparisons,
    markdown_transfer,
)
from dynmap_rl.paper.published import TABLES
from dynmap_rl.paper.results import read_cells

BETTER = "Dynamics are better than Only-RGB"
RECURRENT = "Recurrent policies are better than feed-forward ones"


def compare(folder):
    """Return the comparisons by claim, group, what is compared, and metric."""
    rows = compare_cells(read_cells(folder))
    return {(row["claim"], row["group"], row["comparison"], row["metric"]): row for row in rows}


def test_every_pair_is_of_cells_that_the_paper_has_and_no_two_are_the_same():
    pairs = list_pairs()
    for *column, row in (key for pair in pairs for _, key in pair.terms):
        assert row.removesuffix(", plain CNN") in TABLES[tuple(column)]
    names = {(pair.claim, pair.group, pair.comparison, pair.metric) for pair in pairs}
    assert len(names) == len(pairs)


def test_gaps_of_the_paper_are_those_of_its_tables():
    gaps = {(p.claim, p.group, p.comparison, p.metric): p.paper_gap for p in list_pairs()}
    assert gaps[BETTER, "task 1, feed-forward", "RGB+[P+V]", "SR"] == 85 - 21
    assert gaps[BETTER, "task 1, feed-forward, plain CNN", "RGB+[P+V]", "DR"] == 7 - 55
    assert gaps[BETTER, "task 1, feed-forward", "RGB+[A]", "PE"] == 80 - 69
    less = "Recurrent policies gain less by dynamics", "task 1, decoupled", "RGB+[V]", "SR"
    assert gaps[less] == (85 - 79) - (73 - 21)


def test_cells_that_are_there_are_compared_on_their_start_states(tmp_path):
    assert compare(tmp_path) == {}
    write(tmp_path, "Only-RGB", 20, 22, 18)
    write(tmp_path, "RGB+[V]", 38, 36, 40, position_error=[0.02] * 40)
    write(tmp_path, "RGB+[V]", 30, policy="feedforward")
    found = compare(tmp_path)
    metrics = "SR", "DR", "PE"
    assert set(found) == {
        *((BETTER, "task 1, recurrent", "RGB+[V]", metric) for metric in metrics),
        *((RECURRENT, "task 1, decoupled", "RGB+[V]", metric) for metric in metrics),
    }
    better = found[BETTER, "task 1, recurrent", "RGB+[V]", "SR"]
    assert better["values"] == [95.0, 50.0] and better["gap"] == pytest.approx(45.0)
    assert better["interval"][0] > 20 and better["world_models"] == [3, 3]
    assert better["verdict"] == HOLDS and better["paper"] == 85 - 73
    assert found[BETTER, "task 1, recurrent", "RGB+[V]", "PE"]["gap"] == pytest.approx(10.0)
    text = markdown_comparisons(list(found.values()))
    assert "| task 1, recurrent: RGB+[V] | SR % | 95.0, 50.0 | +45.0 [" in text
    assert "**Decoupled training" not in text


COMPARISON = BETTER, "task 1, recurrent", "RGB+[P]", "SR"


@pytest.mark.parametrize(
    ("without", "with_position", "verdict"),
    [
        ([20, 22, 18], [38, 36, 40], HOLDS),
        ([38, 36, 40], [20, 22, 18], FAILED),
        ([20, 22, 38], [38, 36, 40], OPEN),  # one world model overlaps
        ([10, 26, 28], [30, 32, 40], OPEN),  # they are apart, but differ as much among each other
        ([20, 20, 19], [22, 22, 23], OPEN),  # so small a gap may be one of the scenes
        ([20, 22, 18], [40], OPEN),  # a single world model
    ],
)
def test_a_claim_needs_a_gap_beyond_that_of_scenes_and_of_world_models(
    tmp_path, without, with_position, verdict
):
    write(tmp_path, "Only-RGB", *without)
    write(tmp_path, "RGB+[P]", *with_position)
    assert compare(tmp_path)[COMPARISON]["verdict"] == verdict


@pytest.mark.parametrize(
    ("recurrent", "feedforward", "verdict"),
    [
        ([20, 30, 40], [16, 25, 36], HOLDS),  # better by as much on every world model
        ([38, 36, 40], [20, 22, 36], OPEN),  # apart on average, not on the third world model
        ([20, 22, 18], [18, 20, 16], OPEN),  # equal differences do not say how they vary
    ],
)
def test_policies_on_the_same_world_models_are_compared_in_pairs(tmp_path, recurrent, feedforward, verdict):
    write(tmp_path, "Only-RGB", *recurrent)
    write(tmp_path, "Only-RGB", *feedforward, policy="feedforward")
    found = compare(tmp_path)[RECURRENT, "task 1, decoupled", "Only-RGB", "SR"]
    assert found["verdict"] == verdict


def test_policies_on_partly_other_world_models_are_not_compared_in_pairs(tmp_path):
    """All of them count: a pair of two that happen to share one says little."""
    write(tmp_path, "Only-RGB", 38, 36, 40)
    write(tmp_path, "Only-RGB", 20, 22, 18, policy="feedforward", first=2)
    found = compare(tmp_path)[RECURRENT, "task 1, decoupled", "Only-RGB", "SR"]
    assert found["verdict"] == HOLDS and found["world_models"] == [3, 3]
    expected = ttest_ind([95, 90, 100], [50, 55, 45], equal_var=False).confidence_interval()
    assert found["trainings"] == pytest.approx((expected.low, expected.high))


def test_a_joint_world_model_is_the_same_on_two_tasks(tmp_path):
    write(tmp_path, "RGB+[P]", 20, 22, 24, training="joint")
    write(tmp_path, "RGB+[P]", 30, 33, 35, training="joint", task="balance_reaching_obstacle")
    found = compare(tmp_path)["Task 2 is imitated better than task 1", "joint", "RGB+[P]", "SR"]
    expected = ttest_rel([75, 82.5, 87.5], [50, 55, 60]).confidence_interval()
    assert found["trainings"] == pytest.approx((expected.low, expected.high))


def test_fewer_drops_and_smaller_errors_are_better(tmp_path):
    name = RECURRENT, "task 1, decoupled", "Only-RGB"
    for policy, dropped in (("recurrent", 0), ("feedforward", 10)):
        errors = [(3 + dropped) / 1000] * 40
        write(tmp_path, "Only-RGB", 20, 20, policy=policy, dropped=flags(dropped), position_error=errors)
    row = compare(tmp_path)[*name, "DR"]
    assert row["verdict"] == OPEN and row["trainings"] is None, "no variation between world models"
    errors = [0.014] * 40
    write(tmp_path, "Only-RGB", 20, policy="feedforward", dropped=flags(11), position_error=errors)
    row = compare(tmp_path)[*name, "DR"]
    assert row["gap"] == pytest.approx(-26.25) and row["verdict"] == HOLDS
    row = compare(tmp_path)[*name, "PE"]
    assert row["gap"] == pytest.approx(-10.5) and row["trainings"] == pytest.approx((-16.9, -4.1), abs=0.1)
    assert row["verdict"] == HOLDS


def test_a_gain_is_compared_with_that_of_the_other_policies(tmp_path):
    for row, policy, successes in (
        ("Only-RGB", "recurrent", (30, 31, 33)),
        ("RGB+[V]", "recurrent", (35, 34, 36)),
        ("Only-RGB", "feedforward", (10, 12, 11)),
        ("RGB+[V]", "feedforward", (36, 37, 34)),
    ):
        write(tmp_path, row, *successes, policy=policy)
    found = compare(tmp_path)[
        "Recurrent policies gain less by dynamics", "task 1, decoupled", "RGB+[V]", "SR"
    ]
    gains = (105 - 94) / 120, (107 - 33) / 120
    assert found["gap"] == pytest.approx(100 * (gains[0] - gains[1])) and found["verdict"] == HOLDS
    assert found["values"] == pytest.approx([100 * (105 - 107) / 120, 100 * (94 - 33) / 120])


def test_verdicts_are_counted(tmp_path):
    for row, successes in (("Only-RGB", 20), ("RGB+[P]", 40), ("RGB+[V]", 5), ("RGB+[A]", 20)):
        write(tmp_path, row, successes, successes - 1, task="bin_dropping")
    found, group = compare(tmp_path), "task 3, decoupled"
    verdicts = {name: row["verdict"] for (claim, _, name, _), row in found.items() if claim == BETTER}
    assert verdicts == {"RGB+[P]": HOLDS, "RGB+[V]": FAILED, "RGB+[A]": OPEN}
    lines = markdown_claims(list(found.values())).splitlines()
    gaps = "+2 to +11 | -37.5 to +50.0 points"  # of the three that were run
    some = f"{group} (3 of 7 have runs)"
    assert f"| {BETTER} | {some} | SR | {gaps} | 1 | 1 | 1 | **mixed** |" in lines
    assert "- World models are better than End-to-End: task 1, joint" in lines


@pytest.mark.parametrize(
    ("verdicts", "claim"),
    [
        ([HOLDS, HOLDS], HOLDS),
        ([HOLDS, OPEN], OPEN),
        ([FAILED, OPEN], FAILED),
        ([HOLDS, FAILED, OPEN], MIXED),
        ([OPEN], OPEN),
    ],
)
def test_one_comparison_that_fails_refutes_a_claim(verdicts, claim):
    found = [{"verdict": verdict} for verdict in verdicts]
    assert judge_claim(found, len(found)) == claim
    assert judge_claim(found, len(found) + 1) == (OPEN if claim == HOLDS else claim), "one has no runs"


def test_predictions_are_compared_by_task(tmp_path):
    for task, error in (
        ("balance_reaching", 5.0),
        ("balance_reaching_obstacle", 6.0),
        ("bin_dropping", 700.0),
    ):
        write(tmp_path, "RGB+[P]", 20, 20, task=task)
        for number, path in enumerate(sorted(tmp_path.glob(f"{task}_decoupled*.json"))):
            facts = json.loads(path.read_text()) | {"test_protocol": {"localization": error + number}}
            path.write_text(json.dumps(facts))
    assert "| RGB+[P] | 5.5 | 6.5 | 700.5 |" in markdown_transfer(read_cells(tmp_path)).splitlines()
