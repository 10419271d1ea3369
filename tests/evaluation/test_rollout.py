"""Closed-loop rollouts and their rows."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.modules import LSTMModule

from dynmap_rl.data.recording.plans import draw_pushes
from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.renderer import Renderer
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.tasks import TASKS, get_task
from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.evaluation.protocol import evaluate, judge_in_closed_loop, pack_rows, unpack_rows
from dynmap_rl.evaluation.rollout import episode_rows, failures_first, roll_out
from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.modules.delayed_actor import DelayedActor

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}


def make_actor():
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    return Actor(model, make_policy(CONSTANTS, "feedforward", model, width=16), mixed=True)


@pytest.fixture(scope="module", params=TASKS)
def rolled(request):
    """A task's name, the scenes' seeds, and the episodes of an untrained policy."""
    seeds = scene_seeds("validation", 2)
    return request.param, seeds, roll_out(make_actor(), request.param, seeds)


def test_an_episode_does_not_depend_on_the_others_in_its_batch():
    seeds = scene_seeds("validation", 2)
    together, alone = (roll_out(make_actor(), "balance_reaching", some) for some in (seeds, seeds[1:]))
    torch.testing.assert_close(together["action"][1], alone["action"][0], rtol=1e-3, atol=1e-5)
    assert together.shape == (2, EPISODE_STEPS)


def test_an_actor_may_have_no_parameters():
    still = TensorDictModule(lambda agent_pos: torch.zeros(len(agent_pos), 3), ["agent_pos"], ["action"])
    result = evaluate(still, "balance_reaching", Evaluation(episodes=2, paper_episodes=0))
    assert result["test"]["summary"]["SR"] == 0


def counter():
    """Return a callable that remembers the time step under a key of its own."""

    def act(td):
        step = torch.where(td["is_init"], 0, td.get("step", torch.zeros(len(td), 1, dtype=torch.int64)))
        out = TensorDict({"action": 0.001 * step.float().expand(-1, 3) / 100}, td.batch_size)
        return out.set(("next", "step"), step + 1)

    return act


@pytest.mark.parametrize("seeds", [range(2), np.arange(2), torch.arange(2), [0, 1]])
def test_any_callable_is_rolled_out_from_any_seeds(seeds):
    out = roll_out(counter(), "balance_reaching", seeds)
    torch.testing.assert_close(out["action"][0, :4, 0], torch.tensor([0.0, 1e-5, 2e-5, 3e-5]))
    assert evaluate(counter(), "balance_reaching", Evaluation(episodes=1, paper_episodes=0))


def test_what_an_actor_draws_follows_from_the_scenes():
    def act(td):
        return TensorDict({"action": 0.01 * torch.randn(len(td), 3)}, td.batch_size)

    first, state = roll_out(act, "balance_reaching", [3])["action"], torch.get_rng_state()
    torch.rand(1)
    torch.testing.assert_close(roll_out(act, "balance_reaching", [3])["action"], first)
    assert not torch.equal(roll_out(act, "balance_reaching", [4])["action"], first)
    torch.set_rng_state(state)
    roll_out(act, "balance_reaching", [3])
    assert torch.equal(torch.get_rng_state(), state), "the caller's generator is as before"


def test_torchrl_s_lstm_is_rolled_out():
    lstm = LSTMModule(5, 8, in_key="agent_pos", out_key="x")
    actor = TensorDictSequential(lstm, TensorDictModule(torch.nn.Linear(8, 3), ["x"], ["action"]))
    actor.train()
    lstm.eval()
    assert roll_out(actor, "balance_reaching", [0]).shape == (1, EPISODE_STEPS)
    assert actor.training and not lstm.training, "modes are as before"


@pytest.mark.parametrize("make", [lambda: DelayedActor(make_actor(), max_delay=5), make_actor])
def test_delays_belong_to_the_scene(make):
    seeds, delay = scene_seeds("validation", 2), FrameDelay(3, 2, 0.2)
    together, alone = (
        roll_out(make(), "balance_reaching", some, keep_pixels=True, delay=delay)
        for some in (seeds, seeds[1:])
    )
    torch.testing.assert_close(together["action"][1], alone["action"][0], rtol=1e-3, atol=1e-5)
    task = get_task("balance_reaching")
    world = task.make_world(task.sample_scene(np.random.default_rng(seeds[1])))
    for t, action in enumerate(alone["action"][0, :20].numpy()):  # frames of the present are kept
        frame = torch.from_numpy(Renderer().draw(world, task)).permute(2, 0, 1)
        assert torch.equal(alone["pixels"][0, t], frame)
        world.step(action)


def test_without_delay_all_actors_and_their_predictions_are_the_same():
    arguments = "balance_reaching", scene_seeds("validation", 2)
    expected = roll_out(make_actor(), *arguments)
    for actor, delay in (
        (DelayedActor(make_actor(), max_delay=1), FrameDelay()),
        (make_actor(), FrameDelay()),
    ):
        out = roll_out(actor, *arguments, delay=delay)
        for key in ("action", ("predicted_dynamics", "position"), ("next", "position_error")):
            assert torch.equal(out[key], expected[key])


def test_rows_say_what_happened(rolled):
    task, seeds, episodes = rolled
    rows = episode_rows(episodes, seeds)
    distance = (episodes["dynamics", "position"][..., :2] - episodes["goal"]).norm(dim=-1)
    for i, (row, actions) in enumerate(zip(rows, episodes["action"].numpy(), strict=True)):
        scene = get_task(task).sample_scene(np.random.default_rng(seeds[i]))
        world = get_task(task).make_world(scene)
        for action in actions:
            world.step(action)
        assert row["scene_seed"] == seeds[i]
        assert (row["dropped"], row["touched"]) == (world.dropped, bool(world.touched))
        assert row["success"] is get_task(task).is_success(world)
        assert row["position_error"] == pytest.approx(world.position_error, abs=1e-5)
        # the mean over the last ten observations; the rollout holds all but the very last
        assert abs(row["position_error"] - distance[i, -9:].mean()) < 0.01
        assert row["localization_error"] > 0


def test_errors_of_the_predicted_position_by_hand():
    goal, position = torch.zeros(1, 4, 2), torch.zeros(1, 4, 6)
    predicted = position.clone()
    position[0, :, 0] = torch.tensor([0.5, 0.4, 0.3, 0.05])  # the last step is near the goal
    predicted[0, :, 0] = torch.tensor([9.0, 0.41, 0.32, 0.08])
    flags = {name: torch.zeros(1, 4, 1, dtype=torch.bool) for name in ("dropped", "touched", "is_success")}
    data = {"goal": goal, "dynamics": {"position": position}, "predicted_dynamics": {"position": predicted}}
    data["next"] = flags | {"position_error": torch.zeros(1, 4, 1)}
    [row] = episode_rows(TensorDict(data, [1, 4]), [7])
    assert row["localization_error"] == pytest.approx(0.02)
    data["goal"], position[0, :, 2], predicted[0, :, 2] = torch.zeros(1, 4, 3), 0.0, 0.04
    [row] = episode_rows(TensorDict(data, [1, 4]), [7])
    assert row["localization_error"] == pytest.approx((0.0017**0.5 + 0.002**0.5 + 0.05) / 3, abs=1e-5)


@torch.no_grad()
def test_predictions_are_those_of_the_frames_and_actions():
    actor = make_actor().eval()
    found = roll_out(actor, "balance_reaching", scene_seeds("validation", 2), keep_pixels=True)
    states = actor.world_model.predict(actor.world_model.encode(found["pixels"], mixed=True), found["action"])
    expected = actor.world_model.decode_dynamics(*states)["position"]
    predicted = found["predicted_dynamics", "position"]
    torch.testing.assert_close(predicted[:, 1:], expected[:, 1:], rtol=1e-3, atol=1e-3)
    assert not predicted[:, 0].any()


def test_an_actor_may_have_keys_of_its_own():
    actor = make_actor()
    names = {"predicted_latent": "predicted", "memory": ("h1", "c1", "h2", "c2")}
    renamed = Actor(actor.world_model, actor.policy, mixed=True, **names)
    seeds = scene_seeds("validation", 1)
    plain, other = (roll_out(a, "balance_reaching", seeds) for a in (actor, renamed))
    assert torch.equal(plain["predicted_dynamics", "position"], other["predicted_dynamics", "position"])


def test_an_actor_that_would_use_no_frame_is_refused():
    with pytest.raises(ValueError, match="max_delay of the actor must be at least 6"):
        roll_out(DelayedActor(make_actor(), max_delay=5), "balance_reaching", [0], delay=FrameDelay(7, 1))
    with pytest.raises(ValueError, match=r"such as FrameDelay\(5\)"):
        roll_out(DelayedActor(make_actor(), delay=5), "balance_reaching", [0])
    with pytest.raises(ValueError, match="delay must be a FrameDelay"):
        roll_out(DelayedActor(make_actor(), max_delay=6), "balance_reaching", [0], delay=6)


def test_pushes_act_on_the_cart_but_the_actor_is_not_told():
    seeds, count = scene_seeds("validation", 2), get_task("balance_reaching").pushes
    plain, pushed, again = (
        roll_out(make_actor(), "balance_reaching", seeds, pushed=pushed) for pushed in (False, True, True)
    )
    assert torch.equal(pushed["action"], again["action"])
    other = ((plain["action"] - pushed["action"]).abs() > 1e-4).any(-1)
    first = other.float().argmax(1)
    assert first.tolist() == [draw_pushes(seed, count)[0][0] for seed in seeds]
    assert other.any(1).all() and other.sum() < other.numel()
    for row, t in enumerate(first.tolist()):
        before = [plain["dynamics", "position"][row, : t + 1], pushed["dynamics", "position"][row, : t + 1]]
        assert torch.allclose(*before, atol=1e-5)
        # The prediction of the next step is that of the actor's own action, not of the push.
        predicted = (each["predicted_dynamics", "position"][row, t + 1] for each in (plain, pushed))
        assert torch.allclose(*predicted, atol=1e-5)


def test_both_protocols_on_their_own_scenes():
    actor, settings = make_actor(), Evaluation(episodes=2, paper_episodes=1)
    result = evaluate(actor, "bin_dropping", settings)
    first = [result[name]["rows"]["first_scene_seed"] for name in ("test", "paper")]
    counts = [result[name]["summary"]["episodes"] for name in ("test", "paper")]
    assert [len(result[name]["rows"]["success"]) for name in ("test", "paper")] == counts == [2, 1]
    test, paper = (set(range(seed, seed + count)) for seed, count in zip(first, counts, strict=True))
    train = set(scene_seeds("train", 10_000)) | set(scene_seeds("eval", 10_000))
    assert not test & paper and not (test | paper) & train
    assert judge_in_closed_loop(actor.world_model, actor.policy, "bin_dropping", settings) == result
    rows = unpack_rows(result["test"]["rows"])
    assert [row["success"] for row in rows] == ["cause" not in row for row in rows]
    assert sum(result["test"]["summary"].get("causes", {}).values()) == sum(
        not row["success"] for row in rows
    )


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes(monkeypatch):
    monkeypatch.setattr("dynmap_rl.evaluation.protocol.BATCH", 1)
    actor, settings, delay = make_actor(), Evaluation(episodes=4, paper_episodes=1), FrameDelay(2, 1)
    alone, shared = (
        evaluate(actor, "balance_reaching", settings, delay, pushed=True, workers=n) for n in (1, 2)
    )
    assert alone == shared


def test_rows_survive_their_packing(rolled):
    _, seeds, episodes = rolled
    rows = episode_rows(episodes, seeds)
    rows[-1]["cause"] = "stops short"
    assert ["cause" in row for row in unpack_rows(pack_rows(rows))] == ["cause" in row for row in rows]
    for row, unpacked in zip(rows, unpack_rows(pack_rows(rows)), strict=True):
        error = unpacked.pop("position_error")
        assert error == pytest.approx(row["position_error"], abs=1e-4)
        assert unpacked == {name: row[name] for name in unpacked}


@pytest.mark.parametrize(
    ("settings", "value"),
    [
        ({"split": "train"}, "train"),
        ({"episodes": 0}, "0"),
        ({"episodes": 1001}, "1001"),
        ({"paper_episodes": -1}, "-1"),
    ],
)
def test_settings_are_checked(settings, value):
    with pytest.raises(ValueError, match=value):
        Evaluation(**settings)


@pytest.mark.parametrize(
    ("failed", "shown"),
    [
        ([], [0, 1, 2, 3]),
        ([5], [5, 0, 1, 2]),
        ([3, 4, 7], [3, 4, 0, 1]),
        ([0, 1, 2, 3, 4, 5, 7], [0, 1, 2, 6]),
        (range(8), [0, 1, 2, 3]),
    ],
)
def test_half_of_what_is_shown_failed_where_that_many_did(failed, shown):
    assert failures_first(range(8), [seed not in failed for seed in range(8)], count=4) == shown
    assert failures_first([0, 1], [True, False], count=4) == [1, 0]


def test_failures_alone_are_shown_where_there_are_any():
    assert failures_first(range(8), [seed not in (1, 3, 4) for seed in range(8)], count=2, alone=True) == [
        1,
        3,
    ]
    assert failures_first(range(8), [seed != 5 for seed in range(8)], count=4, alone=True) == [5]
    assert failures_first(range(3), [True] * 3, count=2, alone=True) == [0, 1]
