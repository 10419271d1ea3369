"""Actor and latent actor: step form against sequence form, memory, imagination."""

import warnings

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import set_recurrent_mode

from dynmap_rl.envs.imagination import ImaginationEnv, make_start
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.modules.actor import MEMORY, POLICY_MEMORY, Actor, LatentActor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor

both_kinds = pytest.mark.parametrize("kind", ["feedforward", "recurrent"])


def make_actor(kind="recurrent"):
    model = make_model()
    return Actor(model, make_policy(CONSTANTS, kind, model, width=20)).eval()


def make_env(actor):
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    return TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))


def make_frames(b=2, t=4):
    generator = torch.Generator().manual_seed(0)
    data = {
        "pixels": torch.randint(0, 256, (b, t, 3, 64, 64), dtype=torch.uint8, generator=generator),
        "action": 0.01 * torch.randn(b, t, 3, generator=generator),
        "goal": torch.rand(b, 1, 2, generator=generator).expand(b, t, 2),
    }
    return TensorDict(data, [b, t])


@both_kinds
@torch.no_grad()
def test_rollout_equals_the_sequence_form(kind):
    actor = make_actor(kind)
    env = make_env(actor)
    check_env_specs(env)
    out = env.rollout(10, actor)
    model = actor.world_model
    latent = model.encode(out["pixels"])
    predicted, hidden1, hidden2 = model.predict(latent, out["action"])
    torch.testing.assert_close(out["hidden1"], hidden1, rtol=1e-4, atol=1e-5)
    after = out["next", "predicted_latent"][:, :-1]
    torch.testing.assert_close(after, predicted[:, 1:], rtol=1e-4, atol=1e-5)
    actions = actor.policy(latent, hidden1, hidden2, out["goal"])
    torch.testing.assert_close(out["action"], actions, rtol=1e-3, atol=1e-5)


@both_kinds
@torch.no_grad()
def test_observe_act_and_predict_compose_to_a_call(kind):
    actor, frames = make_actor(kind), make_frames()
    memory = TensorDict({}, [2])
    for t in range(4):
        seen = frames[:, t].select("pixels", "goal").update(memory)
        whole, parts = actor(seen.clone()), seen.clone()
        assert "action" not in actor.observe(parts)
        assert ("next", "hidden1") not in actor.act(parts).keys(True)
        actor.predict(parts)
        assert set(parts.keys(True, True)) == set(whole.keys(True, True))
        assert set(actor.out_keys) <= set(parts.keys(True, True))
        for key in parts.keys(True, True):
            assert torch.equal(parts[key], whole[key]), key
        memory = parts["next"]


@torch.no_grad()
def test_predict_takes_the_action_that_was_executed():
    actor, frames = make_actor(), make_frames()
    td = actor.act(actor.observe(frames[:, 0].select("pixels", "goal")))
    executed = actor.predict(td.clone().set("action", frames["action"][:, 0]))["next"]
    state = actor.world_model.initial_state(2)
    expected, state = actor.world_model.step(td["latent"], frames["action"][:, 0], state)
    assert torch.equal(executed["predicted_latent"], expected)
    for key, value in zip(MEMORY, state, strict=True):
        assert torch.equal(executed[key], value)
    for key in POLICY_MEMORY:
        assert torch.equal(executed[key], td["next", key])


@both_kinds
@torch.no_grad()
def test_without_frames_the_actor_imagines_as_the_imagination_environment(kind):
    actor, frames = make_actor(kind), make_frames()
    start = make_start(actor.world_model, frames)
    latent_actor = LatentActor(actor.policy)
    env = ImaginationEnv(actor.world_model, start)
    env = TransformedEnv(env, Compose(InitTracker(), latent_actor.make_tensordict_primer()))
    expected = env.rollout(6, latent_actor)

    td = start.select("goal", *MEMORY).set("pixels", frames["pixels"][:, -1])
    for t in range(6):
        td = actor(td)
        for key in ("latent", "action", *MEMORY):
            torch.testing.assert_close(td[key], expected[key][:, t], rtol=1e-5, atol=1e-6)
        td = td["next"].set("goal", start["goal"])
    with pytest.raises(KeyError, match="from_pixels"):
        actor(start.select("goal"))


@torch.no_grad()
def test_memory_is_cleared_where_an_episode_begins():
    actor = make_actor()
    td = make_frames()[:, 0].select("pixels", "goal")
    fresh = actor(td.clone())
    sizes = dict.fromkeys(MEMORY, 24) | dict.fromkeys(POLICY_MEMORY, 20)
    td.update({key: torch.ones(2, size) for key, size in sizes.items()})
    out = actor(td.set("is_init", torch.tensor([[True], [False]])))
    for key in ("action", ("next", "predicted_latent"), ("next", "hidden2"), ("next", "policy_hidden2")):
        torch.testing.assert_close(out[key][0], fresh[key][0])
        assert not torch.allclose(out[key][1], fresh[key][1]), key


def test_keys_can_be_renamed_and_nested():
    plain, frames = make_actor(), make_frames()
    memory = tuple(("m", key) for key in MEMORY)
    names = {"pixels": ("camera", "front"), "goal": ("agent", "goal"), "action": ("agent", "action")}
    actor = Actor(plain.world_model, plain.policy, latent=("m", "z"), memory=memory, **names)
    td = frames[:, 0].select("pixels", "goal")
    renamed = TensorDict({("camera", "front"): td["pixels"], ("agent", "goal"): td["goal"]}, [2])
    out, expected = actor(renamed), plain(td)
    assert torch.equal(out["agent", "action"], expected["action"])
    assert torch.equal(out["m", "z"], expected["latent"])
    assert torch.equal(out["next", "m", "cell2"], expected["next", "cell2"])


def test_actor_runs_in_a_collector():
    actor = make_actor()
    collector = Collector(make_env(actor), actor, frames_per_batch=20, total_frames=40)
    frames = [batch.numel() for batch in collector]
    collector.shutdown()
    assert frames == [20, 20]


@pytest.mark.parametrize("make", [make_actor, lambda: DelayedActor(make_actor(), max_delay=2)])
def test_an_environment_that_does_not_pass_the_memory_on_is_refused(make):
    env = TransformedEnv(DynmapBatchedEnv(num_envs=2, from_pixels=True), InitTracker())
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        env.rollout(3, make())


@pytest.mark.parametrize(
    "make",
    [
        make_actor,
        lambda: LatentActor(make_actor().policy),
        lambda: DelayedActor(make_actor(), max_delay=2),
    ],
)
def test_an_actor_without_memory_warns(make):
    actor = make()
    td = TensorDict(
        {key: torch.zeros(2, size) for key, size in (("latent", 16), ("hidden1", 24), ("hidden2", 24))}, [2]
    )
    td = td.set("pixels", torch.zeros(2, 3, 64, 64, dtype=torch.uint8)).set("goal", torch.zeros(2, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):  # episodes of two steps, whose first has no memory yet
            after = actor(td.copy())["next"]
            actor(td.copy().update(after))
            actor(td.copy().set("is_init", torch.ones(2, 1, dtype=torch.bool)))
    actor(td.copy())
    with pytest.warns(UserWarning, match="make_tensordict_primer"):
        actor(td.copy())


def test_a_policy_without_its_memory_gets_the_warning_too():
    actor = make_actor()
    states = {key: torch.zeros(2, 24) for key in actor.memory}  # as of a WorldModelTransform
    td = make_frames()[:, 0].select("pixels", "goal").update(states)
    actor(td.copy())
    with pytest.warns(UserWarning, match="make_tensordict_primer"):
        actor(td.copy())


def test_is_init_of_another_shape_is_refused():
    begins = torch.zeros(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"is_init must be of shape \[2, 1\], got \[2\]"):
        make_actor()(make_frames()[:, 0].select("pixels", "goal").set("is_init", begins))


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
def test_a_goal_of_another_type_is_the_same_goal(kind):
    frames = make_frames()[:, 0]
    actions = [
        make_actor(kind)(frames.copy().set("goal", frames["goal"].to(t)))["action"]
        for t in (torch.float64, None)
    ]
    torch.testing.assert_close(*actions)


def test_windows_are_refused_in_recurrent_mode():
    with set_recurrent_mode(True), pytest.raises(RuntimeError, match="make_world_model_module"):
        make_actor()(make_frames())


def test_memory_that_a_part_of_the_batch_lacks_is_missed():
    td = make_frames()[:, 0].select("pixels", "goal").set("is_init", torch.tensor([[True], [False]]))
    with pytest.raises(KeyError, match="make_tensordict_primer"):
        make_actor()(td)


@torch.no_grad()
def test_any_module_acts_that_returns_actions_alone():
    class Policy(torch.nn.Module):
        def forward(self, latent, hidden1, hidden2, goal):
            return latent[..., :3] + goal[..., :1]

    class WithMemory(torch.nn.Module):
        def forward(self, latent, hidden1, hidden2, goal):
            return goal, (goal,)

    world_model, frames = make_actor().world_model, make_frames()[:, 0].select("pixels", "goal")
    td = Actor(world_model, Policy())(frames.copy())
    torch.testing.assert_close(td["action"], td["latent"][..., :3] + td["goal"][..., :1])
    with pytest.raises(TypeError, match="RecurrentPolicy.* of WithMemory"):
        Actor(world_model, WithMemory())(frames.copy())


@torch.no_grad()
def test_an_episode_does_not_begin_with_a_latent_predicted_in_the_last_one():
    actor, frames = make_actor(), make_frames()
    td = actor(frames[:, 0].exclude("action"))["next"].copy().set("goal", frames["goal"][:, 1])
    actor(td.copy().set("is_init", torch.zeros(2, 1, dtype=torch.bool)))
    with pytest.raises(KeyError, match="must begin with a frame"):
        actor(td.set("is_init", torch.tensor([[True], [False]])))
