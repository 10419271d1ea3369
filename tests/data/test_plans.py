"""Rollouts are recorded as they happened, row by row, in every task."""

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.recording.plans import Plan, mark_pushes, plan_demonstrations, push, run_plans
from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.experts.network import find_expert, list_checkpoints
from dynmap_rl.keys import DYNAMICS

SLOW = (pytest.param("balance_reaching_obstacle", marks=pytest.mark.slow),)


@pytest.fixture(params=["balance_reaching", *SLOW, "bin_dropping"])
def dataset(request, recordings):
    return recordings(request.param)


def plan_of(row: dict) -> Plan:
    pushes = tuple(tuple(span) for span in row["pushes"])
    return Plan(row["scene_seed"], row["checkpoint"], row["noise"], row["detours"], pushes)


def test_round_trip_is_exact(dataset):
    episodes, meta = load_dataset(dataset), load_meta(dataset)
    assert episodes.shape == (len(meta["episodes"]), 120)
    plans = [plan_of(row) for row in meta["episodes"]]
    assert torch.equal(episodes["disturbed"], mark_pushes(plans)) and episodes["disturbed"].any()
    truth, shard = run_plans(meta["task"], plans[2:4], meta["expert"]), slice(2, 4)
    keys = ["pixels", "agent_pos", "goal", "action", *(("dynamics", name) for name in DYNAMICS)]
    for key in [*keys, *(("next", name) for name in ("reward", "done", "is_success"))]:
        assert episodes[shard][key].dtype == truth[key].dtype
        assert torch.equal(episodes[shard][key], truth[key]), key


def test_replay_of_the_stored_actions_from_the_stored_scene(dataset):
    episodes, meta = load_dataset(dataset), load_meta(dataset)
    task = get_task(meta["task"])
    for episode, row in zip(episodes, meta["episodes"], strict=True):
        world = task.make_world(task.ranges.scene.from_dict(row["scene"]))
        for step in episode:
            for name in DYNAMICS:
                np.testing.assert_array_equal(
                    step["dynamics", name].numpy(), getattr(world, name).astype(np.float32)
                )
            world.step(step["action"].numpy())
            assert step["next", "is_success"].item() == task.is_success(world)
            assert step["next", "reward"].item() == np.float32(task.reward(world))
        assert row["position_error"] == pytest.approx(world.position_error, abs=1e-6)


def test_a_row_is_what_was_seen_before_its_action(dataset):
    episodes = load_dataset(dataset).double()
    position, velocity, acceleration = (episodes["dynamics", name] for name in DYNAMICS)
    change = (velocity[:, 1:] - velocity[:, :-1]) / CONTROL_DT
    torch.testing.assert_close(acceleration[:, 1:], change, atol=1e-4, rtol=0)
    assert not acceleration[:, 0].any()
    assert not velocity[:, 0].any()
    moved = position[:, 1:, :3] - position[:, :-1, :3]
    commanded = episodes["agent_pos"][..., :3]
    torch.testing.assert_close(
        commanded[:, 1:] - commanded[:, :-1], episodes["action"][:, :-1], atol=1e-6, rtol=0
    )
    # The cart moves by the mean of the last and the present commanded velocity: P_{t+1} follows a_t.
    mean = (episodes["action"][:, :-1] + torch.cat([0 * moved[:, :1], episodes["action"][:, :-2]], 1)) / 2
    torch.testing.assert_close(moved, mean, atol=2e-6, rtol=0)
    off_by_one = (episodes["action"][:, 1:] + episodes["action"][:, :-1]) / 2
    assert (moved - off_by_one).abs().max() > 1e-4


def test_the_expert_s_actions_are_those_that_the_cart_could_execute(monkeypatch):
    """This expert accelerates up to the wall."""
    monkeypatch.setattr(
        "dynmap_rl.data.recording.plans._expert_acceleration", lambda *_: np.array([[9.0, 0, 0]])
    )
    plan = Plan(3, list_checkpoints("balance_reaching")[-1])
    episode = run_plans("balance_reaching", [plan])
    assert torch.equal(episode["expert_action"], episode["action"])


def test_every_push_is_another_and_constant():
    world, plan = SimpleNamespace(action=np.zeros(3)), Plan(3, "any", pushes=((0, 3), (5, 8)))
    actions = np.full((9, 1, 3), 9.0)
    for t, action in enumerate(actions):
        push(t, action, [plan], [world])
    assert (actions[[3, 4, 8]] == 9).all()
    assert (actions[:3] == actions[0]).all() and (actions[5:8] == actions[5]).all()
    assert (actions[0] != actions[5]).all()


def test_next_columns_come_after_the_action(dataset):
    meta, after = load_meta(dataset), load_dataset(dataset)["next"]
    assert after["is_success"][:, -1].all()
    early = after["is_success"][:, 60:-1]
    assert early.any() if meta["task"] == "bin_dropping" else not early.any()
    assert not after["is_success"][:, 0].any()


@pytest.mark.parametrize("task", TASKS)
def test_pushes_are_as_many_as_the_task_says_and_most_of_them_early(task):
    plans = plan_demonstrations(task, "train", 0, 60)
    disturbed = [plan.pushes for plan in plans if plan.pushes]
    assert len(disturbed) == 20
    assert len([plan for plan in plans if plan.noise]) == 40
    assert {len(pushes) for pushes in disturbed} == {get_task(task).pushes}
    starts = [start for pushes in disturbed for start, _ in pushes]
    assert min(starts) >= 0 and max(starts) <= 95
    assert np.median(starts) < 30
    assert all(2 <= end - start <= 6 for pushes in disturbed for start, end in pushes)
    assert {plan.checkpoint for plan in plans} == set(list_checkpoints(task))


def test_undisturbed_demonstrations_are_of_the_same_scenes_and_experts():
    plans, same = (
        plan_demonstrations("bin_dropping", "train", 5, 9, disturbed=some) for some in (True, False)
    )
    assert [(p.scene_seed, p.checkpoint) for p in plans] == [(p.scene_seed, p.checkpoint) for p in same]
    assert any(p.noise and p.pushes for p in plans)
    assert not any(p.noise or p.pushes for p in same)


@pytest.mark.slow
def test_expert_of_a_folder_is_recorded(tmp_path):
    """One shipped checkpoint in another folder, by another name, acts as ever."""
    expert, shipped = tmp_path / "checkpoint", list_checkpoints("bin_dropping")[-1]
    small = {"episodes": 2, "eval_episodes": 1, "workers": 1}
    expert.mkdir()
    for suffix in ("json", "safetensors"):
        shutil.copy(find_expert("bin_dropping") / f"{shipped}.{suffix}", expert / f"mine.{suffix}")
    root = record_dataset(tmp_path / "d", "bin_dropping", **small, expert=expert)
    meta = load_meta(root)
    assert meta["expert"] == str(expert)
    assert {row["checkpoint"] for row in meta["episodes"]} == {"mine"}
    plans = [plan_of({**row, "checkpoint": shipped}) for row in meta["episodes"][:2]]
    assert torch.equal(load_dataset(root, "train")["action"], run_plans("bin_dropping", plans)["action"])
    assert record_dataset(root, "bin_dropping", **small, expert=str(expert)) == root
    with pytest.raises(ValueError, match=f"expert {expert} instead of bin_dropping"):
        record_dataset(root, "bin_dropping", **small)
