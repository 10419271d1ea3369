"""The paper's numbers for our rows."""

import pytest

from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.paper.published import paper_numbers


def row(task, training, policy, name, trained_on="balance_reaching") -> dict:
    source = {"task": trained_on, "training": training}
    return {"task": task, "row": name, "policy": policy, "world_model": source}


@pytest.mark.parametrize(
    ("cell", "numbers"),
    [
        # Table I
        (
            ("balance_reaching", "decoupled", "feedforward", "Only-RGB"),
            {"DR": (55, 2.5), "PE": (69, 15.6), "SR": (21, 5.7)},
        ),
        (
            ("balance_reaching", "decoupled", "recurrent", "RGB+[P+V]"),
            {"DR": (5, 2.5), "PE": (23, 3.7), "SR": (89, 0.9)},
        ),
        (
            ("balance_reaching", "joint", "recurrent", "RGB+[P+A]"),
            {"DR": (6, 4.3), "PE": (34, 2.1), "SR": (79, 6.2)},
        ),
        (
            ("balance_reaching", "end_to_end", "recurrent", "End-to-End"),
            {"DR": (19, 9.0), "PE": (71, 21.9), "SR": (57, 10.6)},
        ),
        # Table II
        (
            ("balance_reaching_obstacle", "decoupled", "recurrent", "RGB+[V+A]"),
            {"DR": (1, 0.9), "SR": (83, 8.1)},
        ),
        (
            ("balance_reaching_obstacle", "joint", "recurrent", "RGB+[P+V+A]"),
            {"DR": (1, 1.9), "SR": (87, 6.6)},
        ),
        # Table III
        (("bin_dropping", "decoupled", "recurrent", "RGB+[A]"), {"SR": (55, 6.2)}),
        (("bin_dropping", "joint", "recurrent", "RGB+[V]"), {"SR": (40, 2.8)}),
        (("bin_dropping", "end_to_end", "recurrent", "End-to-End"), {"SR": (47, 4.1)}),
        # No such row
        (("bin_dropping", "decoupled", "recurrent", "End-to-End"), None),
        (("bin_dropping", "decoupled", "feedforward", "Only-RGB"), None),
        (("balance_reaching", "joint", "feedforward", "Only-RGB"), None),
        (("my_tasks:Lift", "decoupled", "recurrent", "Only-RGB"), None),
    ],
)
def test_cells_of_the_papers_tables(cell, numbers):
    assert paper_numbers(row(*cell)) == numbers


@pytest.mark.parametrize("training", ["decoupled", "joint"])
@pytest.mark.parametrize("task", TASKS)
def test_the_papers_world_models_are_all_of_task_1(task, training):
    assert paper_numbers(row(task, training, "recurrent", "Only-RGB"))
    for other in {*TASKS, "my_tasks:Lift"} - {"balance_reaching"}:
        assert paper_numbers(row(task, training, "recurrent", "Only-RGB", trained_on=other)) is None


def test_a_robot_dataset_has_no_row_in_the_paper():
    assert (
        paper_numbers(row(None, "decoupled", "recurrent", "Only-RGB") | {"world_model": {"dataset": "x"}})
        is None
    )
