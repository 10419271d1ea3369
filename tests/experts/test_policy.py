"""The shipped experts: complete, deterministic, and good at their task."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dynmap_rl.envs import DynmapBatchedEnv, scene_seed
from dynmap_rl.envs.world import ACCELERATION_LIMIT
from dynmap_rl.experts import ExpertNetwork, list_checkpoints, load_expert, make_actor
from dynmap_rl.experts.policy import CHECKPOINTS
from dynmap_rl.runs import read_json

TASK = "balance_reaching"
LIMIT = (3.0, 3.0, 10.0)


def test_last_checkpoint_succeeds_on_fresh_scenes():
    env = DynmapBatchedEnv(TASK, num_envs=10, control="acceleration")
    seeds = torch.tensor([scene_seed("exploration", i) for i in range(10)])
    policy = TensorDictModule(load_expert(TASK), in_keys=["state"], out_keys=["action", "scale"])
    start = env.reset(TensorDict({"scene_seed": seeds}, [10]))
    rollout = env.rollout(120, policy, auto_reset=False, tensordict=start, break_when_any_done=False)
    assert rollout["next", "is_success"][:, -1].sum() >= 9


@pytest.mark.parametrize("checkpoint", list_checkpoints(TASK))
def test_every_checkpoint_loads_and_has_its_facts(checkpoint):
    facts = read_json(CHECKPOINTS / TASK / f"{checkpoint}.json")
    assert facts["task"] == TASK
    assert checkpoint == f"iteration_{facts['iteration']:03d}"
    assert 0 <= facts["drop"] <= 1 and 0 <= facts["success"] <= 1
    assert facts["frames"] > 0 and facts["episodes"] > 0 and facts["position_error"] > 0
    network = load_expert(TASK, checkpoint)
    assert network.limit.tolist() == ACCELERATION_LIMIT.tolist()
    assert not any(p.requires_grad for p in network.parameters())


def test_last_checkpoint_is_the_default_and_loading_is_deterministic():
    state = torch.randn(5, 16)
    mean, _ = load_expert(TASK)(state)
    assert torch.equal(load_expert(TASK, list_checkpoints(TASK)[-1])(state)[0], mean)
    assert not torch.equal(load_expert(TASK, list_checkpoints(TASK)[0])(state)[0], mean)


def test_unknown_task_or_checkpoint_raises():
    with pytest.raises(ValueError, match="no expert is shipped for task 'nope'"):
        list_checkpoints("nope")
    with pytest.raises(ValueError, match="no expert is shipped for task 'nope'"):
        load_expert("nope")
    with pytest.raises(ValueError, match=f"no checkpoint 'nope'.*{list_checkpoints(TASK)[-1]}"):
        load_expert(TASK, "nope")


def test_mean_stays_within_the_limit():
    mean, scale = ExpertNetwork(16, LIMIT)(1e3 * torch.randn(4, 7, 16))
    assert mean.shape == scale.shape == (4, 7, 3)
    assert (mean.abs() <= torch.tensor(LIMIT)).all()
    assert (scale > 0).all()


def test_actor_samples_and_gives_the_log_probability():
    actor = make_actor(load_expert(TASK))
    with set_exploration_type(ExplorationType.RANDOM):
        td = actor(TensorDict({"state": torch.randn(6, 16)}, [6]))
    assert td["action"].shape == (6, 3)
    assert td["action_log_prob"].shape == (6,)
    normal = torch.distributions.Normal(td["loc"], td["scale"])
    torch.testing.assert_close(td["action_log_prob"], normal.log_prob(td["action"]).sum(-1))
    assert not torch.equal(td["action"], td["loc"])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(actor(td.select("state"))["action"], td["loc"])
