"""A frozen world model as a transform: in rollouts, collectors, processes and windows it is the world model itself."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector, Evaluator
from torchrl.envs import Compose, InitTracker, ParallelEnv, ToTensorImage, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dynmap_rl.envs.task import LAYOUT, Task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world_model_transform import WorldModelTransform
from dynmap_rl.modules.actor import MEMORY, Actor, LatentActor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}
WRITTEN = ("latent", "predicted_latent", *MEMORY)
CLOSE = {"rtol": 1e-5, "atol": 1e-5}


def make_model():
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24).eval()


def make_env(num_envs=3, control="position", **arguments):
    env = DynmapBatchedEnv(num_envs=num_envs, from_pixels=True, control=control, seed=0)
    return TransformedEnv(env, Compose(InitTracker(), WorldModelTransform(make_model(), **arguments)))


def make_latent_actor():
    model = make_model()
    return LatentActor(make_policy(CONSTANTS, "recurrent", model, width=20))


def make_latent_env():
    env = make_env(2)
    env.append_transform(make_latent_actor().make_tensordict_primer())
    return env


def close(a: TensorDict, b: TensorDict) -> None:
    for key in WRITTEN:
        torch.testing.assert_close(a[key], b[key], **CLOSE)


@pytest.mark.parametrize("arguments", [{}, {"agent_pos": "agent_pos"}, {"mixed": True}])
def test_specs(arguments):
    env = make_env(**arguments)
    check_env_specs(env, seed=0)
    assert {env.observation_spec[key].shape[-1] for key in MEMORY} == {24}
    check_env_specs(TransformedEnv(DynmapBatchedEnv(from_pixels=True), WorldModelTransform(make_model())))


@torch.no_grad()
def test_a_rollout_is_what_the_world_model_makes_of_the_sequence():
    model, out = make_model(), make_env().rollout(15)
    latent = model.encode(out["pixels"])
    torch.testing.assert_close(out["latent"], latent, **CLOSE)
    for key, value in zip(
        ("predicted_latent", "hidden1", "hidden2"), model.predict(latent, out["action"]), strict=True
    ):
        torch.testing.assert_close(out[key], value, **CLOSE)
        torch.testing.assert_close(out["next", key][:, :-1], value[:, 1:], **CLOSE)
    assert not any(value.requires_grad for value in out.values(True, True))


@pytest.fixture
def short_episodes(monkeypatch):
    monkeypatch.setattr(Task, "layout", replace(LAYOUT, steps=12))


def test_each_episode_of_a_long_rollout_begins_with_an_empty_memory(short_episodes):
    env = make_env()
    start = env.reset()
    env.base_env.worlds[0].steps = 5  # so that worlds are reset one at a time
    arguments = {"auto_reset": False, "tensordict": start, "break_when_any_done": False}
    out = env.rollout(30, **arguments)
    resets = out["is_init"][:, 1:]
    assert (resets.sum(1) > 0).all() and (resets.sum(0) == 1).any()
    for key in ("predicted_latent", *MEMORY):
        assert (out[key][out["is_init"].squeeze(-1)] == 0).all()
    row = out[0]
    starts = [*row["is_init"].flatten().nonzero().flatten().tolist(), 30]
    for first, end in pairwise(starts):
        episode = row[first:end].select("pixels", "action")[None].clone()
        close(WorldModelTransform(make_model())(episode)[0], row[first:end])


def test_a_partial_reset_leaves_the_other_worlds_as_they_are():
    env = make_env()
    before = env.rollout(6)[:, -1]["next"].exclude("reward")
    after = env.reset(before.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    for key in WRITTEN:
        assert torch.equal(after[key][[0, 2]], before[key][[0, 2]])
        assert not torch.equal(after[key][1], before[key][1])
    torch.testing.assert_close(after["latent"][1], make_model().encode(after["pixels"][1]), **CLOSE)
    assert all((after[key][1] == 0).all() for key in ("predicted_latent", *MEMORY))


@torch.no_grad()
def test_the_change_of_the_commanded_pose_is_the_action_that_was_taken():
    """Under accelerations, too hard to be executed as they are, the world model still hears of position updates."""
    env = make_env(control="acceleration", agent_pos="agent_pos")
    td = env.reset()
    for _ in range(5):
        after = env.step(td.set("action", torch.full((3, 3), 50.0)))["next"]
        taken = torch.tensor([world.action.tolist() for world in env.base_env.worlds])
        state = tuple(td[key] for key in MEMORY)
        predicted, _ = make_model().step(td["latent"], taken, state)
        torch.testing.assert_close(after["predicted_latent"], predicted, **CLOSE)
        td = after
    with pytest.raises(KeyError, match="agent_pos"):
        WorldModelTransform(make_model(), agent_pos="agent_pos")(env.rollout(3).exclude("next"))


def test_windows_with_several_episodes_equal_the_collector_s_states(short_episodes):
    collector = Collector(make_env(), None, frames_per_batch=90, total_frames=90)
    [batch] = list(collector)
    collector.shutdown()
    assert batch["is_init"][:, 1:].any()
    close(WorldModelTransform(make_model())(batch.select("pixels", "action", "is_init").clone()), batch)
    with pytest.raises(ValueError, match=r"\[B, T\]"):
        WorldModelTransform(make_model())(batch[0])


def test_nested_keys():
    names = {"latent": ("m", "z"), "predicted_latent": ("m", "p"), "memory": [("m", k) for k in MEMORY]}
    env = make_env(**names)
    check_env_specs(env)
    env.set_seed(0)
    assert torch.equal(env.rollout(1)["m", "z"], make_env().rollout(1)["latent"])


@torch.no_grad()
def test_a_policy_on_the_transform_acts_as_the_actor_on_frames():
    actor = make_latent_actor()
    whole = Actor(make_model(), actor.policy)
    frames = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    frames = TransformedEnv(frames, Compose(InitTracker(), whole.make_tensordict_primer()))
    expected = frames.rollout(12, whole)
    env = make_latent_env()
    check_env_specs(env)
    env.set_seed(0)
    out = env.rollout(12, actor)
    for key in ("action", "latent", "hidden2", "policy_hidden2"):
        torch.testing.assert_close(out[key], expected[key], rtol=1e-3, atol=1e-5)
    nested = Actor(
        make_model(),
        actor.policy,
        latent=("m", "z"),
        memory=[("m", k) for k in MEMORY],
        policy_memory=[("p", k) for k in MEMORY],
    )
    frames = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    frames = TransformedEnv(frames, Compose(InitTracker(), nested.make_tensordict_primer()))
    check_env_specs(frames)
    frames.set_seed(0)
    assert torch.equal(frames.rollout(12, nested)["p", "hidden2"], expected["policy_hidden2"])


def test_scenes_can_be_chosen_through_a_transform():
    env = make_env()
    td = env.reset(scene_seed=torch.tensor([3, 4, 3]))
    plain = DynmapBatchedEnv(num_envs=3).reset(TensorDict({"scene_seed": torch.tensor([3, 4, 3])}, [3]))
    assert torch.equal(td["goal"], plain["goal"])
    torch.testing.assert_close(
        td["latent"][0], td["latent"][2], atol=1e-6, rtol=0
    )  # rows of a batch, added up in turns
    assert not torch.allclose(td["latent"][0], td["latent"][1], atol=1e-4)


@pytest.mark.filterwarnings("ignore:trajs_per_batch:FutureWarning")
@pytest.mark.filterwarnings("ignore:Nested TransformedEnvs:UserWarning")
def test_torchrl_evaluates_the_policies():
    success = lambda batch: {"success": batch["next", "is_success"].float().mean().item()}  # noqa: E731
    for env, policy in ((make_latent_env(), make_latent_actor()), (make_actor_env(), make_actor())):
        evaluator = Evaluator(env, policy, num_trajectories=2, max_steps=10, metrics_fn=success)
        metrics = evaluator.evaluate()
        evaluator.shutdown()
        assert metrics["eval/num_episodes"] == 2 and 0 <= metrics["eval/success"] <= 1


def make_actor():
    return Actor(make_model(), make_latent_actor().policy)


def make_actor_env():
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True, seed=0)
    return TransformedEnv(env, Compose(InitTracker(), make_actor().make_tensordict_primer()))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*use of fork")
@torch.no_grad()
@pytest.mark.parametrize("make", [make_latent_env, make_actor_env])
def test_in_processes_of_their_own(make):
    """[workers, worlds]: the transform in each worker, or one transform around them."""
    policy = make_latent_actor() if make is make_latent_env else make_actor()
    env = ParallelEnv(2, make, mp_start_method="fork")  # spawned ones could not import this file
    try:
        check_env_specs(env)
        out = env.rollout(8, policy)
        assert out.shape == (2, 2, 8)
        model, first = make_model(), out[0]
        latent = model.encode(first["pixels"])
        torch.testing.assert_close(first["latent"], latent, **CLOSE)
        _, hidden1, _ = model.predict(latent, first["action"])
        torch.testing.assert_close(first["hidden1"], hidden1, rtol=1e-4, atol=1e-5)
        outer = TransformedEnv(env, Compose(InitTracker(init_key="begins")))
        check_env_specs(outer)
    finally:
        env.close()


def test_an_environment_without_uint8_frames_is_refused():
    for env in (
        DynmapBatchedEnv(),
        TransformedEnv(DynmapBatchedEnv(from_pixels=True), ToTensorImage(shape_tolerant=True)),
    ):
        with pytest.raises(ValueError, match="uint8 frames"):
            TransformedEnv(env, WorldModelTransform(make_model())).rollout(2)
