"""What is asked of a task of one's own, and what it is told where it differs."""

import numpy as np
import point_task
import pytest
import torch
from small import CONSTANTS, make_model

from dynmap_rl.data.recording.demonstrators import demonstrate
from dynmap_rl.data.recording.plans import plan_demonstrations, run_plans
from dynmap_rl.envs import DynmapBatchedEnv
from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.task_env import TaskEnv
from dynmap_rl.envs.tasks import BalanceReaching, get_task
from dynmap_rl.envs.world import LARGEST_CHANGE
from dynmap_rl.evaluation.rollout import episode_rows, roll_out
from dynmap_rl.experts.careless import CarelessController
from dynmap_rl.experts.network import task_of_expert
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor
from dynmap_rl.play.session import Session


class Point(point_task.Point):
    """The same, in this module."""


class LongState(Point):
    """One entry too many."""

    def agent_pos(self, world):
        return np.append(super().agent_pos(world), 0.0)


class OtherState(Point):
    """A state of another size than it says."""

    state_size = 3


class FlatFrames(Point):
    """Frames of half the height."""

    def make_renderer(self):
        return lambda world: np.zeros((32, 64, 3), np.uint8)


class FloatFrames(Point):
    """Frames of numbers from 0 to 1."""

    def make_renderer(self):
        return lambda world: np.zeros((64, 64, 3))


class ShortVelocity(Point):
    """A velocity of one entry."""

    def begin(self, seed, ranges=None, world=None):
        world = super().begin(seed)
        world.velocity = np.zeros(1)
        return world


class Named(Point):
    """A task whose name cannot be written."""

    @property
    def name(self):
        return "named"

    def __init__(self, size=64):
        self.size = size


class Hasty(BalanceReaching):
    """Cart and block, with a demonstrator that wants to be at the goal at once."""

    def demonstrator(self, world):
        return lambda: np.array([*(world.goal - world.commanded[:2]), 0.0])


def name(task):
    return f"{__name__}:{task.__name__}"


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (LongState, r"agent_pos of the task point must have the shape \(4,\), got \(5,\)"),
        (OtherState, r"state of the task point must have the shape \(3,\)"),
        (FlatFrames, r"frame of the task point must have the shape \(64, 64, 3\)"),
        (FloatFrames, "must be uint8, got float64"),
        (ShortVelocity, r"velocity of the task point must have the shape \(2,\)"),
    ],
)
def test_sizes_are_those_of_the_layout(task, message):
    with pytest.raises(ValueError, match=message):
        DynmapBatchedEnv(name(task), from_pixels=True).reset()
    if task is not OtherState:  # which recordings do not read
        with pytest.raises(ValueError, match=message):
            demonstrate(name(task), [0])


def test_an_action_limit_is_one_of_an_entry():
    with pytest.raises(ValueError, match="action_limit must have 2 entries"):
        Layout(10, 20, ("x", "y"), (0.1,), ("x", "goal_x"), ("x",), ("x",))


def test_arguments_need_a_name_that_can_be_written():
    assert get_task(name(Named)).name == "named"
    with pytest.raises(ValueError, match="must be a class attribute"):
        get_task(f"{name(Named)}:size=96")


def test_actions_are_cut_in_every_environment():
    batched, single = DynmapBatchedEnv(name(Point)), TaskEnv(name(Point))
    td, _ = batched.reset(scene_seed=torch.tensor([3])), single.reset(seed=3)
    start = td["dynamics", "position"][0]
    after = batched.step(td.set("action", torch.tensor([[5.0, -5.0]])))["next"]["dynamics", "position"][0]
    torch.testing.assert_close(after - start, torch.tensor([point_task.LIMIT, -point_task.LIMIT]))
    np.testing.assert_allclose(single.step(np.array([5.0, -5.0]))[0]["agent_pos"][:2], after)


def test_a_cart_of_a_demonstrator_of_ones_own_is_recorded_as_it_moves():
    plans = plan_demonstrations(name(Hasty), "train", 0, 3)
    assert not any(plan.pushes for plan in plans) and any(plan.noise for plan in plans)
    episodes = run_plans(name(Hasty), plans)
    moved = episodes["agent_pos"][:, 1:, :3] - episodes["agent_pos"][:, :-1, :3]
    torch.testing.assert_close(moved, episodes["action"][:, :-1], atol=1e-6, rtol=0)
    first = episodes["expert_action"][:, 0].abs()
    assert (first <= torch.as_tensor(LARGEST_CHANGE) + 1e-6).all(), (
        "from rest, within the limit of acceleration"
    )


def make_actor():
    model = make_model()
    return Actor(model, make_policy(CONSTANTS, "feedforward", model, width=8))


@pytest.mark.parametrize("wrap", [lambda actor: actor, lambda actor: DelayedActor(actor, max_delay=2)])
def test_a_policy_of_another_task_is_refused(wrap):
    message = "must be of point, got another one: action 3 instead of 2"
    with pytest.raises(ValueError, match=message):
        roll_out(wrap(make_actor()), name(Point), [0])
    with pytest.raises(ValueError, match=message):
        Session(name(Point), make_actor())


def test_what_needs_cart_and_block_says_so():
    task = get_task(name(Point))
    with pytest.raises(ValueError, match="cart and block"):
        CarelessController(task)
    with pytest.raises(ValueError, match="point does not have"):
        task_of_expert("balance_reaching", task)
    with pytest.raises(ValueError, match="cart and block"):
        roll_out(lambda td: td, name(Point), [0], pushed=True)


def test_a_goal_that_is_no_point_has_no_distance():
    episodes = roll_out(lambda td: td.set("action", torch.zeros(2, 2)), name(Point), [0, 1])
    episodes["predicted_dynamics", "position"] = episodes["dynamics", "position"] + 0.03
    found = episode_rows(episodes, [0, 1])
    assert found[0]["localization_error"] == pytest.approx(0.03 * 2**0.5, abs=1e-4)
    episodes["goal"] = episodes["goal"][..., :1]
    assert "localization_error" not in episode_rows(episodes, [0, 1])[0]
