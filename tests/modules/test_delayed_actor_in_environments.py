"""Delayed actor in TorchRL environments with late frames."""

from dataclasses import replace

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import Compose, InitTracker, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.delay_transform import DelayTransform
from dynmap_rl.envs.task import LAYOUT, Task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.delayed_actor import DelayedActor

DELAY = FrameDelay(3, 2, 0.2)


def make_actor(kind="recurrent"):
    model = make_model()
    return Actor(model, make_policy(CONSTANTS, kind, model, width=20)).eval()


def make_env(actor, delay=DELAY, bursts=True):
    env = DynmapBatchedEnv(num_envs=2, from_pixels=True, include_state=False, seed=0)
    transforms = DelayTransform(delay, seed=0, bursts=bursts), InitTracker(), actor.make_tensordict_primer()
    return TransformedEnv(env, Compose(*transforms))


@pytest.mark.parametrize("kind", ["feedforward", "recurrent"])
@pytest.mark.parametrize("bursts", [True, False])
@torch.no_grad()
def test_rollouts_and_collectors(kind, bursts, monkeypatch):
    monkeypatch.setattr(Task, "layout", replace(LAYOUT, steps=8))
    actor = DelayedActor(make_actor(kind), max_delay=5)
    env = make_env(actor, bursts=bursts)
    check_env_specs(env)
    out = env.rollout(8, actor)
    memory = TensorDict({}, [2])
    for t in range(8):  # as without a primer
        td = actor(memory.update(out[:, t].select("pixels", "delay", "goal")))
        torch.testing.assert_close(td["action"], out["action"][:, t], rtol=1e-4, atol=1e-5)
        memory = td["next"]
    collector = Collector(make_env(actor, bursts=bursts), actor, frames_per_batch=40, total_frames=40)
    [batch] = list(collector)
    collector.shutdown()
    begins = batch["is_init"].squeeze(-1)
    assert begins[:, 8].all() and (batch["history", "step"].squeeze(-1)[begins] == 0).all()
    assert (batch["history", "arrived"][:, 8].sum((1, 2)) == 1).all()


@torch.no_grad()
def test_in_an_environment_without_delay_a_rollout_is_the_actor_s():
    actor = make_actor()
    delayed = DelayedActor(actor, max_delay=2)
    plain = DynmapBatchedEnv(num_envs=2, from_pixels=True, include_state=False, seed=0)
    plain = TransformedEnv(plain, Compose(InitTracker(), actor.make_tensordict_primer()))
    expected = plain.rollout(10, actor)
    out = make_env(delayed, FrameDelay()).rollout(10, delayed)
    for key in ("action", "latent", ("next", "hidden1"), ("next", "policy_hidden2")):
        assert torch.equal(out[key], expected[key])


def test_an_episode_begins_with_a_frame():
    env = DynmapBatchedEnv(num_envs=2)
    actor = DelayedActor(make_actor(), max_delay=2)
    env = TransformedEnv(env, Compose(InitTracker(), actor.make_tensordict_primer()))
    with pytest.raises(KeyError, match="from_pixels=True"):
        env.rollout(3, actor)
