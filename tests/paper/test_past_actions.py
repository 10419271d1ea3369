"""The baseline with past actions: what it reads, in training and in closed loop."""

import pytest
import torch
from small import CONSTANTS, make_model
from tensordict import TensorDict

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.paper.past_actions import PastActionsActor, PastActionsPolicy, train_past_actions
from dynmap_rl.training.settings import PolicyTraining


def make_policy(model, max_delay=6):
    torch.manual_seed(1)
    action, goal = (Normalizer(**CONSTANTS[name]) for name in ("action", "goal"))
    return PastActionsPolicy(model.latent_size, model.hidden_size, action, goal, max_delay, width=32)


@pytest.mark.parametrize("delay", [0, 1, 4])
@torch.no_grad()
def test_the_actor_acts_on_the_state_of_the_frame_and_the_actions_around_it(delay):
    model = make_model().eval()
    actor = PastActionsActor(model, make_policy(model))
    seeds = scene_seeds("validation", 2)
    episodes = roll_out(actor, "balance_reaching", seeds, keep_pixels=True, delay=FrameDelay(delay))
    latent = model.encode(episodes["pixels"], mixed=True)
    _, hidden1, hidden2 = model.predict(latent, episodes["action"])
    for t in (0, 1, delay, delay + 1, 50):
        k = max(t - delay, 0)
        past = torch.zeros(2, 6, 3)
        since = episodes["action"][:, max(k - 1, 0) : t]
        past[:, 6 - since.shape[1] :] = since
        state = latent[:, k], hidden1[:, k], hidden2[:, k]
        age = torch.full((2, 1), t - k)
        expected = actor.policy(*state, episodes["goal"][:, t], past, age)
        torch.testing.assert_close(episodes["action"][:, t], expected, rtol=1e-3, atol=1e-4)


def test_actions_more_than_a_step_before_the_frame_are_not_read():
    model = make_model()
    policy = make_policy(model)
    state = torch.randn(1, model.latent_size), *torch.randn(2, 1, model.hidden_size), torch.zeros(1, 2)
    past, age = torch.randn(1, 6, 3), torch.tensor([[2]])
    before, since = past.clone(), past.clone()
    before[:, :3] += 1
    since[:, 3] += 1
    assert torch.equal(policy(*state, before, age), policy(*state, past, age))
    assert not torch.equal(policy(*state, since, age), policy(*state, past, age))


def test_training_learns_what_only_past_actions_tell():
    """The action to imitate is the last one, and states are noise."""
    model = make_model()
    policy, generator = make_policy(model), torch.Generator().manual_seed(0)
    executed = torch.randn(20, 30, 3, generator=generator) * policy.action.scale + policy.action.center
    target = torch.cat([torch.zeros_like(executed[:, :1]), executed[:, :-1]], 1)
    sizes = {"latent": model.latent_size, "hidden1": model.hidden_size, "hidden2": model.hidden_size}
    features = {name: torch.randn(20, 30, size, generator=generator) for name, size in sizes.items()}
    features |= {"goal": torch.zeros(20, 30, 2), "action": target}
    features["disturbed"] = torch.zeros(20, 30, 1, dtype=torch.bool)
    features = TensorDict(features, [20, 30])

    def error(age):
        t = torch.arange(6, 30)
        past = torch.stack([executed[:, t - 6 + k] for k in range(6)], 2)
        state = (features[name][:, t - age] for name in sizes)
        ages = torch.full((20, len(t), 1), age)
        found = policy(*state, features["goal"][:, t], past, ages)
        return ((found - target[:, t]) / policy.action.scale).abs().mean().item()

    before = error(0), error(3)
    train_past_actions(policy, features, executed, PolicyTraining(updates=300, batch=8, emphasis=0))
    assert error(0) < 0.5 * before[0] and error(3) < 0.5 * before[1]
