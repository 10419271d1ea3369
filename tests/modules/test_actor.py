import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.checkpoints import make_world_model

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}


def make_actor(kind="recurrent"):
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=16, hidden_size=24)
    return Actor(model, make_policy(CONSTANTS, kind, model, width=20)).eval()


def make_env(actor, num_envs=2):
    env = DynmapBatchedEnv(num_envs=num_envs, from_pixels=True, seed=0)
    return TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
@torch.no_grad()
def test_rollout_equals_the_sequence_form(kind):
    actor = make_actor(kind)
    env = make_env(actor)
    check_env_specs(env)
    out = env.rollout(10, actor)
    model = actor.world_model
    latent = model.encode(out["pixels"])
    _, hidden1, hidden2 = model.predict(latent, out["action"])
    torch.testing.assert_close(out["hidden1"], hidden1, rtol=1e-4, atol=1e-5)
    actions = actor.policy(latent, hidden1, hidden2, out["goal"])
    torch.testing.assert_close(out["action"], actions, rtol=1e-3, atol=1e-5)


@torch.no_grad()
def test_memory_is_cleared_where_an_episode_begins():
    actor = make_actor()
    td = TensorDict(
        {
            "pixels": torch.randint(0, 256, (2, 3, 64, 64), dtype=torch.uint8),
            "goal": torch.rand(2, 2),
            "is_init": torch.tensor([[True], [False]]),
            **{key: torch.ones(2, 24) for key in ("hidden1", "cell1", "hidden2", "cell2")},
        },
        [2],
    )
    fresh = actor(td.select("pixels", "goal"))
    out = actor(td)
    torch.testing.assert_close(out["action"][0], fresh["action"][0])
    assert not torch.allclose(out["action"][1], fresh["action"][1])


def test_actor_runs_in_a_collector():
    actor = make_actor()
    collector = Collector(make_env(actor), actor, frames_per_batch=20, total_frames=40)
    frames = [batch.numel() for batch in collector]
    collector.shutdown()
    assert frames == [20, 20]


def test_evaluation_rollout_matches_the_environments_rollout():
    actor = make_actor()
    out = roll_out(actor, "balance_reaching", [3, 4], keep_pixels=True)
    env = DynmapBatchedEnv(num_envs=2)
    td = env.reset(TensorDict({"scene_seed": torch.tensor([3, 4])}, [2]))
    for t in range(out.shape[1]):
        assert torch.equal(td["dynamics", "position"], out["dynamics", "position"][:, t])
        td = env.step(td.set("action", out["action"][:, t]))["next"]
    assert torch.equal(td["position_error"], out["next", "position_error"][:, -1])
