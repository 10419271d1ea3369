"""Causes of failures, of made-up trajectories."""

from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.envs.tasks import BinDropping
from dynmap_rl.evaluation.failures import CAUSES, failure_causes

STEPS, START, GOAL = 60, torch.tensor([0.2, 0.5]), torch.tensor([0.8, 0.5])


def episode(end, drop=None, touch=None, speed=0.0, block=(0.0, 0.0), success=False, tip=None, above=0.0):
    """An episode in which the cart goes from start to ``end`` in 40 steps, faster and then slower, and stays there.

    The block begins to tip before ``tip``, by default ``drop``.
    """
    share = torch.linspace(0, 1, 40)
    share = torch.cat([(3 * share**2 - 2 * share**3), torch.ones(STEPS - 40)])[:, None]
    cart = START + share * (torch.tensor(end) - START)
    velocity = torch.zeros(STEPS, 6)
    velocity[1:, :2] = (cart[1:] - cart[:-1]) / 0.05
    velocity[-15:, 0] += speed
    acceleration = torch.zeros(STEPS, 6)
    acceleration[1:] = (velocity[1:] - velocity[:-1]) / 0.05
    position = torch.zeros(STEPS, 6)
    position[:, :2] = cart
    position[:, 3:5] = GOAL + torch.tensor(block)
    if drop is not None:
        position[(tip or drop) :, 5] = 1.0
    flags = {name: torch.zeros(STEPS, 1, dtype=torch.bool) for name in ("dropped", "touched", "is_success")}
    for name, step in (("dropped", drop), ("touched", touch)):
        if step is not None:
            flags[name][step:] = True
    flags["is_success"][-1] = success
    dynamics = {"position": position, "velocity": velocity, "acceleration": acceleration}
    return TensorDict({"dynamics": dynamics, "goal": GOAL.expand(STEPS, 2), "next": flags}, [STEPS])


def causes(*episodes, task="balance_reaching"):
    return failure_causes(torch.stack(episodes), task)


@pytest.mark.parametrize(
    ("given", "cause"),
    [
        ({"end": GOAL.tolist(), "success": True}, None),
        ({"end": GOAL.tolist(), "drop": 3}, "drops at the start"),
        ({"end": GOAL.tolist(), "drop": 13}, "drops while accelerating"),
        ({"end": GOAL.tolist(), "drop": 28}, "drops while braking"),
        ({"end": GOAL.tolist(), "drop": 28, "tip": 13}, "drops while accelerating"),
        ({"end": GOAL.tolist(), "drop": 50}, "drops at the goal"),
        ({"end": [0.6, 0.5]}, "stops short"),
        ({"end": [0.9, 0.5]}, "overshoots"),
        ({"end": [0.8, 0.6]}, "stops beside the goal"),
        ({"end": [0.6, 0.5], "speed": 0.1}, "still moves at the end"),
        ({"end": GOAL.tolist(), "touch": 20}, "touches the obstacle"),
        ({"end": GOAL.tolist(), "touch": 10, "drop": 13}, "touches the obstacle"),
        ({"end": GOAL.tolist(), "touch": 20, "drop": 13}, "drops while accelerating"),
        ({"end": GOAL.tolist(), "touch": 13, "drop": 13}, "drops while accelerating"),
    ],
)
def test_causes_of_tasks_1_and_2(given, cause):
    assert causes(episode(**given)) == [cause] and cause in (None, *CAUSES)


def test_a_block_tips_as_seen_from_the_cart():
    tilted = episode(GOAL.tolist(), drop=28, tip=13)
    tilted["dynamics", "position"][:, 2] = 0.2  # of the cart, and of the block on it
    tilted["dynamics", "position"][:13, 5] = 0.2
    assert causes(tilted) == ["drops while accelerating"]


def test_acceleration_is_that_around_the_step():
    noisy = episode(GOAL.tolist(), drop=13)
    noisy["dynamics", "acceleration"][12] *= -0.5
    assert causes(noisy) == ["drops while accelerating"]


def test_causes_of_task_3():
    end = GOAL.tolist()
    found = causes(
        episode(end),
        episode(end, drop=20, block=(0.3, -0.2)),
        episode(end, drop=20, block=(0.05, -0.4)),
        episode(end, drop=20, block=(0.2, -0.05)),
        episode(end, drop=20, block=(0.05, 0.06)),
        episode(end, drop=20, block=(0.05, -0.05)),
        episode(end, drop=20, success=True),
        task="bin_dropping",
    )
    beside = "drops beside the bin"
    assert found == ["keeps the block", *[beside] * 4, "in the bin, but touched or moving", None]
    assert set(found) - {None} <= set(CAUSES)


@pytest.mark.parametrize(
    ("end", "given", "cause"),
    [
        ([0.6, 0.5], {}, "stops short"),
        ([0.9, 0.5], {}, "overshoots"),
        ([0.205, 0.5], {}, "hardly moves the object"),
        ([0.6, 0.5], {"drop": 30}, "loses the object"),
        ([0.6, 0.5], {"speed": 0.1}, "stops short"),
        ([0.75, 0.5], {"above": 0.1}, "ends above or below the goal"),
        ([0.6, 0.5], {"success": True}, None),
    ],
)
def test_causes_of_tasks_that_move_an_object(end, given, cause):
    pytest.importorskip("gymnasium_robotics")
    made = episode(end, **given)
    flat, height = made["dynamics", "position"], torch.full((STEPS, 1), 0.4)
    made["dynamics", "position"] = torch.cat([flat[:, :2], height, flat], -1)  # the object, and more
    made["goal"] = torch.cat([made["goal"], height + given.get("above", 0.0)], -1)
    assert causes(made, task="mujoco:FetchPush") == [cause]


class WideBin(BinDropping):
    """A task of one's own."""


@pytest.mark.parametrize(
    ("task", "cause"),
    [
        (WideBin(), "keeps the block"),
        (SimpleNamespace(layout=SimpleNamespace(goal_size=0, position=["x", "y"])), "other"),
        (SimpleNamespace(layout=SimpleNamespace(goal_size=3, position=["x", "y"])), "other"),
    ],
)
def test_causes_of_tasks_of_ones_own(task, cause, monkeypatch):
    """A task that is derived from one of the three has its causes; without a place to compare with, nothing is known."""
    monkeypatch.setattr("dynmap_rl.evaluation.failures.get_task", lambda name: task)
    assert causes(episode(GOAL.tolist())) == [cause]
