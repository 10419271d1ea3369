"""The batched TorchRL environment: its specs, its resets, and its agreement with the Gymnasium ids."""

import copy
import pickle
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import InitTracker, MultiAction, ParallelEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import ACCELERATION_LIMIT, ACTION_LIMIT
from dynmap_rl.keys import GYMNASIUM_IDS

every_task = pytest.mark.parametrize("task", TASKS)

LIMIT = {"position": ACTION_LIMIT.tolist(), "acceleration": ACCELERATION_LIMIT.tolist()}


def seeded(env: DynmapBatchedEnv, seeds) -> TensorDict:
    """A reset to the scenes of these seeds."""
    return env.reset(TensorDict({"scene_seed": torch.tensor(list(seeds))}, [len(seeds)]))


def play(env: DynmapBatchedEnv, seeds, actions: torch.Tensor) -> TensorDict:
    """The ``next`` entries ``[N, T]`` of actions ``[N, T, 3]`` from these scenes, past any drop."""
    td = seeded(env, seeds)
    return torch.stack([env.step(td.set("action", a).clone())["next"] for a in actions.unbind(1)], 1)


def random_actions(count: int, steps: int, control: str = "position") -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return (2 * torch.rand(count, steps, 3, generator=generator) - 1) * torch.tensor(LIMIT[control])


@every_task
@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"num_envs": 3},
        {"num_envs": 2, "from_pixels": True},
        {"num_envs": 2, "from_pixels": True, "control": "acceleration"},
        {"num_envs": 2, "include_state": False},
    ],
)
def test_specs(task, arguments):
    env = DynmapBatchedEnv(task, **arguments)
    check_env_specs(env, seed=0)


def test_other_dtypes_than_float32():
    torch.set_default_dtype(torch.float64)
    try:
        check_env_specs(DynmapBatchedEnv(num_envs=2), seed=0)
    finally:
        torch.set_default_dtype(torch.float32)
    env = DynmapBatchedEnv(num_envs=2, seed=0)
    td = env.step(env.reset().set("action", torch.full((2, 3), 0.01, dtype=torch.bfloat16)))
    assert (td["next", "agent_pos"] - td["agent_pos"])[:, 0] == pytest.approx([0.01] * 2, rel=0.5)


def test_without_the_state_nothing_privileged_is_observed():
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True, include_state=False, seed=0)
    rollout = env.rollout(3)
    for entries in (env.observation_spec, env.input_spec, env.reset(), rollout, rollout["next"]):
        assert not {"state", "dynamics"} & set(entries.keys())
    assert {"pixels", "agent_pos", "goal", "is_success"} <= set(rollout["next"].keys())


@every_task
def test_dynamics_are_read_as_they_are_observed(task):
    hidden, shown = (DynmapBatchedEnv(task, 2, include_state=state, seed=0) for state in (False, True))
    tds = [env.reset() for env in (hidden, shown)]
    for action in random_actions(2, 5).unbind(1):
        dynamics = hidden.read_dynamics()
        assert dynamics.batch_size == (2,) and (dynamics == tds[1]["dynamics"]).all()
        tds = [
            env.step(td.set("action", action))["next"] for env, td in zip((hidden, shown), tds, strict=True)
        ]


@every_task
@pytest.mark.parametrize("control", LIMIT)
def test_same_trajectory_as_gymnasium(task, control):
    seeds, actions = [0, 123_456_789], random_actions(2, 25, control)
    batched = DynmapBatchedEnv(task, num_envs=2, from_pixels=True, control=control)
    start, steps = seeded(batched, seeds), play(batched, seeds, actions)
    for i, seed in enumerate(seeds):
        arguments = {"obs_type": "pixels_agent_pos", "control": control}
        env = gym.make(GYMNASIUM_IDS[task], **arguments).unwrapped
        observation, _ = env.reset(seed=seed)
        same_observation(start[i], observation, env)
        for t in range(25):
            observation, reward, terminated, truncated, info = env.step(actions[i, t].numpy())
            step = steps[i, t]
            same_observation(step, observation, env)
            assert step["reward"].item() == np.float32(reward)
            assert (step["terminated"].item(), step["truncated"].item()) == (terminated, truncated)
            for key, value in info.items():
                assert step[key].item() == value


def same_observation(td: TensorDict, observation: dict, env: gym.Env) -> None:
    np.testing.assert_array_equal(td["pixels"].permute(1, 2, 0), observation["pixels"])
    np.testing.assert_array_equal(td["agent_pos"], observation["agent_pos"])
    np.testing.assert_array_equal(td["state"], env.task.state(env.world))
    for name in ("position", "velocity", "acceleration"):
        np.testing.assert_array_equal(td["dynamics", name], getattr(env.world, name).astype(np.float32))


@every_task
def test_number_of_worlds_does_not_matter(task):
    actions = random_actions(5, 12)
    together = play(DynmapBatchedEnv(task, num_envs=5, from_pixels=True), range(5), actions)
    alone = DynmapBatchedEnv(task, num_envs=1, from_pixels=True)
    for i in range(5):
        assert (play(alone, [i], actions[i : i + 1])[0] == together[i]).all()


def test_a_renderer_may_draw_into_one_array(monkeypatch):
    seeds, actions = range(3), random_actions(3, 2)
    expected = play(DynmapBatchedEnv(num_envs=3, from_pixels=True), seeds, actions)["pixels"]
    draw, picture = TASKS["balance_reaching"].make_renderer(), np.zeros((64, 64, 3), np.uint8)

    def draw_into(world) -> np.ndarray:
        picture[:] = draw(world)
        return picture

    env = DynmapBatchedEnv(num_envs=3, from_pixels=True)
    env.draw = draw_into
    assert torch.equal(play(env, seeds, actions)["pixels"], expected)


@every_task
def test_partial_reset_touches_only_the_masked_worlds(task):
    env = DynmapBatchedEnv(task, num_envs=3, seed=0)
    td = env.rollout(5, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    worlds = list(env.worlds)
    mask = torch.tensor([[False], [True], [False]])
    after = env.reset(td.clone().set("_reset", mask))
    assert [a is b for a, b in zip(env.worlds, worlds, strict=True)] == [True, False, True]
    assert [w.steps for w in env.worlds] == [5, 0, 5]
    assert (after[0] == td[0]).all() and (after[2] == td[2]).all()
    assert not torch.equal(after["goal"][1], td["goal"][1])
    assert (after["dynamics", "velocity"][1] == 0).all()


def test_partial_reset_shows_the_other_worlds_as_they_are():
    """Whatever callers have done to what was last seen of them; ``_reset`` is what TorchRL's wrappers call."""
    env = DynmapBatchedEnv(num_envs=3, seed=0)
    env.step(env.rand_action(env.reset()))["next"].apply_(torch.Tensor.zero_)
    after = env._reset(TensorDict({"_reset": torch.tensor([[False], [True], [False]])}, [3]))
    assert [world.steps for world in env.worlds] == [1, 0, 1]
    for seen, world in zip(after, env.worlds, strict=True):
        np.testing.assert_array_equal(seen["state"], env.task.state(world))
        np.testing.assert_array_equal(seen["dynamics", "position"], world.position.astype(np.float32))


def test_worlds_that_torchrl_holds_stay_as_they_are():
    """In a chunk of actions, a world whose block falls is not judged again."""
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    td = env.reset()
    before = td.clone()
    td = env.step(td.set("action", env.action_spec.high).set("_step", torch.tensor([True, False])))
    assert [world.steps for world in env.worlds] == [1, 0]
    for key in ("pixels", "agent_pos", "state", "done"):
        assert torch.equal(td["next", key][1], before[key][1])
    assert td["next", "reward"][1] == 0 and td["next", "reward"][0] != 0

    seeds, turn = (
        range(2),
        torch.tensor([[0.02, 0, 0.05], [0, 0, 0]]),
    )  # the first turns until the block falls
    chunks = TransformedEnv(DynmapBatchedEnv(num_envs=2), MultiAction(dim=1))
    td = chunks.reset(scene_seed=torch.tensor(list(seeds)))
    chunks.step(td.set("action", turn[:, None].expand(2, 100, 3).contiguous()))
    alone = play(DynmapBatchedEnv(num_envs=2), seeds, turn[:, None].expand(2, 100, 3))
    fallen = int(alone["terminated"][0].squeeze(-1).float().argmax())
    assert [world.steps for world in chunks.base_env.worlds] == [fallen + 1, 100]


def test_closing_closes_every_world(monkeypatch):
    closed = []
    env = DynmapBatchedEnv(num_envs=2)
    env.reset()
    worlds = list(env.worlds)
    monkeypatch.setattr(type(env.task), "close", lambda task, world: closed.append(world))
    env.close()
    assert closed == worlds and env.is_closed
    with pytest.raises(RuntimeError, match="reset"):
        env.step(env.fake_tensordict())


def test_seed_determines_every_scene_that_follows():
    def goals(env, seed):
        env.set_seed(seed)
        return torch.stack([env.reset()["goal"] for _ in range(2)])

    env = DynmapBatchedEnv(num_envs=2)
    first = goals(env, 1)
    assert torch.equal(goals(env, 1), first)
    assert torch.equal(goals(DynmapBatchedEnv(num_envs=2), 1), first)
    assert not torch.equal(goals(env, 2), first)
    assert len(first.reshape(-1, 2).unique(dim=0)) == 4


@every_task
def test_ranges_are_a_parameter(task):
    ranges = replace(TASKS[task].ranges, cart_width=(0.4, 0.5))
    env = DynmapBatchedEnv(task, num_envs=5, ranges=ranges)
    env.reset()
    assert all(0.4 <= world.scene.cart_width <= 0.5 for world in env.worlds)


def test_episodes_follow_each_other_in_a_rollout():
    env = DynmapBatchedEnv(num_envs=2, seed=0)
    rollout = env.rollout(250, lambda td: td.set("action", torch.zeros(2, 3)), break_when_any_done=False)
    done = rollout["next", "done"].squeeze(-1)
    assert done.nonzero()[:, 1].tolist() == [119, 239, 119, 239]
    goals = rollout["goal"]
    assert torch.equal(goals[:, 0], goals[:, 119])
    assert (goals[:, 119] != goals[:, 120]).all()
    assert (rollout["dynamics", "velocity"][:, 120] == 0).all()


def test_scene_seeds_hold_for_one_episode():
    env = DynmapBatchedEnv(num_envs=2, seed=0)
    policy = lambda td: td.set("action", torch.zeros(2, 3))  # noqa: E731
    start = seeded(env, [3, 3])
    rollout = env.rollout(121, policy, auto_reset=False, tensordict=start, break_when_any_done=False)
    assert torch.equal(rollout["goal"][0, 0], rollout["goal"][1, 0])
    assert not torch.equal(rollout["goal"][0, 120], rollout["goal"][1, 120])


def test_works_in_a_collector():
    env = DynmapBatchedEnv(num_envs=2, seed=0)
    collector = Collector(env, None, frames_per_batch=20, total_frames=60)
    batches = list(collector)
    assert [batch.shape for batch in batches] == [(2, 10)] * 3
    position = torch.cat([batch["dynamics", "position"] for batch in batches], 1)
    following = torch.cat([batch["next", "dynamics", "position"] for batch in batches], 1)
    going_on = ~torch.cat([batch["next", "done"] for batch in batches], 1)[:, :-1].squeeze(-1)
    assert torch.equal(position[:, 1:][going_on], following[:, :-1][going_on])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork")
def test_worlds_in_processes_of_their_own_are_the_same_worlds():
    make = partial(DynmapBatchedEnv, num_envs=2, from_pixels=True)
    env = ParallelEnv(2, make, mp_start_method="fork")
    try:
        check_env_specs(env)
        check_env_specs(TransformedEnv(env, InitTracker()))
        env.set_seed(3)
        out = env.rollout(5)
    finally:
        env.close()
    seed = 3
    for worker in range(2):
        env = make()
        seed = env.set_seed(seed)
        alone = env.reset()
        assert torch.equal(out["goal"][worker, :, 0], alone["goal"])
        for t in range(5):
            assert torch.equal(out["pixels"][worker, :, t], alone["pixels"])
            alone = env.step(alone.set("action", out["action"][worker, :, t]))["next"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork")
@pytest.mark.parametrize("processes", [1, 2, 4])
def test_the_same_trajectories_in_any_number_of_processes(processes):
    seeds, rng = torch.arange(4), np.random.default_rng(0)
    actions = torch.from_numpy(rng.normal(0, 0.005, (10, 4, 3))).float()

    def trajectory(env, td):
        for action in actions:
            td = env.step(td.set("action", action.view(*env.batch_size, 3)))["next"]
            yield td["dynamics"].clone().view(-1), td["pixels"].flatten(0, -4)

    alone = DynmapBatchedEnv(num_envs=4, from_pixels=True)
    expected = list(trajectory(alone, alone.reset(scene_seed=seeds)))
    make = partial(DynmapBatchedEnv, num_envs=4 // processes, from_pixels=True)
    env = ParallelEnv(processes, make, mp_start_method="fork")
    try:
        td = env.reset(list_of_kwargs=[{"scene_seed": some} for some in seeds.split(4 // processes)])
        for (dynamics, pixels), (same, drawn) in zip(trajectory(env, td), expected, strict=True):
            assert (dynamics == same).all() and torch.equal(pixels, drawn)
    finally:
        env.close()


def test_seeds_may_be_a_list():
    env = DynmapBatchedEnv(num_envs=2)
    assert torch.equal(env.reset(scene_seed=[3, 4])["state"], seeded(env, [3, 4])["state"])


def test_an_environment_with_frames_can_be_copied_and_pickled():
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True)
    env.reset(scene_seed=torch.tensor([1, 2]))
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        same = other.reset(scene_seed=torch.tensor([1, 2]))
        assert torch.equal(same["pixels"], env.reset(scene_seed=torch.tensor([1, 2]))["pixels"])
