"""The paper's claims, tested on made-up results."""

import pytest
from made_up import flags, write

from dynmap_rl.paper.findings import (
    DROPS,
    FAILED,
    HOLDS,
    OPEN,
    compare_cells,
    list_pairs,
    markdown_claims,
    markdown_comparisons,
)
from dynmap_rl.paper.published import TABLES
from dynmap_rl.paper.results import read_cells


def compare(folder):
    """Return the comparisons by claim and by what is compared."""
    return {(row["claim"], row["comparison"]): row for row in compare_cells(read_cells(folder))}


def test_every_pair_is_of_cells_that_the_paper_has_and_no_two_are_the_same():
    pairs = list_pairs()
    for *column, row in (key for pair in pairs for key in (pair.a, pair.b)):
        assert row.removesuffix(", plain CNN") in TABLES[tuple(column)]
    assert len({(pair.claim, pair.comparison) for pair in pairs}) == len(pairs)


def test_cells_that_are_there_are_compared_on_their_start_states(tmp_path):
    assert compare(tmp_path) == {}
    write(tmp_path, "Only-RGB", 20, 22, 18)
    write(tmp_path, "RGB+[V]", 38, 36, 40)
    write(tmp_path, "RGB+[V]", 30, policy="feedforward")
    found = compare(tmp_path)
    assert set(found) == {
        ("Dynamics beat Only-RGB", "task 1, recurrent: RGB+[V] - Only-RGB"),
        ("Recurrent policies beat feed-forward ones", "RGB+[V]"),
        (DROPS, "RGB+[V]"),
    }
    better = found["Dynamics beat Only-RGB", "task 1, recurrent: RGB+[V] - Only-RGB"]
    assert better["rates"] == [95.0, 50.0] and better["gap"] == pytest.approx(45.0)
    assert better["interval"][0] > 20 and (better["scenes"], better["world_models"]) == (40, [3, 3])
    assert better["verdict"] == HOLDS and better["group"] == "without position"
    text = markdown_comparisons(list(found.values()))
    assert "| task 1, recurrent: RGB+[V] - Only-RGB | 95.0 - 50.0 | +45.0 [" in text
    assert "**Decoupled training beats joint training**" not in text


COMPARISON = "Dynamics beat Only-RGB", "task 1, recurrent: RGB+[P] - Only-RGB"


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
    found = compare(tmp_path)["Recurrent policies beat feed-forward ones", "Only-RGB"]
    assert found["verdict"] == verdict


def test_drops_are_compared_as_drops(tmp_path):
    for policy, dropped in (("recurrent", 0), ("feedforward", 10)):
        write(tmp_path, "Only-RGB", 20, 20, policy=policy, dropped=flags(dropped))
    [row] = [row for (claim, _), row in compare(tmp_path).items() if claim == DROPS]
    assert row["verdict"] == OPEN and row["trainings"] is None, "no variation between world models"
    write(tmp_path, "Only-RGB", 20, policy="feedforward", dropped=flags(11))
    [row] = [row for (claim, _), row in compare(tmp_path).items() if claim == DROPS]
    assert row["gap"] == pytest.approx(-26.25)
    assert row["verdict"] == HOLDS, "fewer drops are better"


def test_verdicts_are_counted(tmp_path):
    task = "bin_dropping"
    for row, successes in (("Only-RGB", 20), ("RGB+[P]", 40), ("RGB+[V]", 5), ("RGB+[A]", 20)):
        write(tmp_path, row, successes, successes - 1, task=task)
    found, claim = compare(tmp_path), "Dynamics beat Only-RGB on task 3"
    verdicts = {name.split(" - ")[0]: row["verdict"] for (c, name), row in found.items() if c == claim}
    assert verdicts == {"RGB+[P]": HOLDS, "RGB+[V]": FAILED, "RGB+[A]": OPEN}
    lines = markdown_claims(list(found.values())).splitlines()
    assert f"| {claim} | without position | **open** | 0 | 1 | 1 | -37.5 to +0.0 |" in lines
    assert f"| {claim} | with position | **holds** | 1 | 0 | 0 | +50.0 |" in lines
