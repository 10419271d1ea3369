"""Corrections: the policy acts, the expert says what it would have done."""

import numpy as np
import pytest
import torch
from small import CONSTANTS, judge, make_episodes, make_model
from tensordict.nn import TensorDictModule

from dynmap_rl.data.features import compute_features
from dynmap_rl.data.recording.plans import Plan, run_plans
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.world import LARGEST_CHANGE
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training import PolicyTraining, train_policies
from dynmap_rl.training.dagger import FIRST_SCENE, add_corrections, check_corrections, collect_corrections


class Replay(torch.nn.Module):
    """A policy that plays actions ``[E, T, 3]`` from memory."""

    def __init__(self, actions):
        super().__init__()
        self.actions, self.weight, self.t = actions, torch.nn.Parameter(torch.zeros(1)), -1

    def forward(self, pixels):
        self.t += 1
        return self.actions[:, self.t]


def from_memory(actions):
    return TensorDictModule(Replay(actions), in_keys=["pixels"], out_keys=["action"])


def test_a_policy_that_acts_like_the_expert_is_not_corrected():
    seeds, checkpoint = [scene_seed("train", i) for i in (5, 6)], list_checkpoints("balance_reaching")[-1]
    truth = run_plans("balance_reaching", [Plan(seed, checkpoint) for seed in seeds])
    corrected = collect_corrections(from_memory(truth["action"]), "balance_reaching", seeds)
    assert corrected.shape == (2, 120)
    for key in ("pixels", "goal", "action", "expert_action", ("dynamics", "velocity")):
        torch.testing.assert_close(corrected[key], truth[key], rtol=0, atol=1e-6, msg=str(key))
    assert not corrected["failed"].any()


def test_steps_after_a_failure_are_marked_and_actions_are_those_that_the_cart_executed():
    """Full acceleration to one side drops the block; the expert would have done something else."""
    actions = torch.zeros(1, 120, 3)
    actions[:, :, 0] = 0.04 * torch.from_numpy(np.sign(np.sin(np.arange(120) / 4))).float()
    corrected = collect_corrections(from_memory(actions), "balance_reaching", [scene_seed("train", 0)])
    failed = corrected["failed"][0, :, 0]
    assert not failed[0] and failed[-1] and failed.int().diff().min() == 0
    assert not torch.equal(corrected["action"], corrected["expert_action"])
    assert (corrected["action"].diff(dim=1).abs() <= torch.from_numpy(LARGEST_CHANGE) + 1e-6).all()


def test_a_correction_is_what_the_cart_could_execute(monkeypatch):
    monkeypatch.setattr(
        "dynmap_rl.training.dagger.load_expert", lambda task: lambda state: [torch.full((1, 3), 1e3)]
    )
    still = from_memory(torch.zeros(1, 120, 3))
    corrected = collect_corrections(still, "balance_reaching", [scene_seed("train", 0)])["expert_action"][0]
    torch.testing.assert_close(corrected, torch.from_numpy(LARGEST_CHANGE).float().expand(120, 3))


def test_corrections_join_the_states_and_steps_after_a_failure_are_left_out():
    model = make_model().requires_grad_(False)
    policy = make_policy(CONSTANTS, "recurrent", model, width=16)
    episodes = make_episodes(steps=120)["train"]
    features = compute_features(model, episodes)
    both = add_corrections(features, model, policy, "balance_reaching", scenes=2, seed=0)
    assert len(both) == len(features) + 2
    assert torch.equal(both["latent"][:-2], features["latent"])
    assert not torch.equal(both["goal"][-2], both["goal"][-1])
    seeds = [scene_seed("train", FIRST_SCENE + i) for i in range(2)]
    failed = collect_corrections(Actor(model, policy, mixed=True), "balance_reaching", seeds)["failed"]
    assert failed.any() and torch.equal(both["disturbed"][-2:], failed)
    other = add_corrections(features, model, policy, "balance_reaching", scenes=2, seed=1)
    assert not torch.isin(other["goal"][-2:, 0, 0], both["goal"][-2:, 0, 0]).any()


def test_seeds_without_scenes_are_refused_before_the_training():
    check_corrections(PolicyTraining(corrections=100), "balance_reaching", [989_999])
    with pytest.raises(ValueError, match="seeds must be at most 989999"):
        check_corrections(PolicyTraining(corrections=100), "balance_reaching", [0, 990_000])


def test_training_goes_on_with_the_corrections(tmp_path):
    settings = PolicyTraining("recurrent", updates=3, batch=2, corrections=2, correction_updates=2)
    train_policies(
        make_model(),
        make_episodes(steps=120),
        CONSTANTS,
        tmp_path,
        settings,
        judge=judge,
        task="balance_reaching",
        seeds=(0,),
    )
    assert [row["step"] for row in read_metrics(tmp_path / "seed_0")] == [3, 5]


def test_corrections_need_an_expert(tmp_path):
    with pytest.raises(ValueError, match="expert"):
        train_policies(
            make_model(), make_episodes(), CONSTANTS, tmp_path, PolicyTraining(corrections=2), judge=judge
        )
    assert not any(tmp_path.iterdir())
