"""Corrections: the student acts, the expert says what it would have done."""

import numpy as np
import torch
from tensordict.nn import TensorDictModule

from dynmap_rl.data.recording.plans import Plan, roll_out
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.training.dagger import collect_corrections


class Replay(torch.nn.Module):
    """A student that plays actions ``[E, T, 3]`` from memory."""

    def __init__(self, actions):
        super().__init__()
        self.actions, self.weight, self.t = actions, torch.nn.Parameter(torch.zeros(1)), -1

    def forward(self, pixels):
        self.t += 1
        return self.actions[:, self.t]


def student(actions):
    return TensorDictModule(Replay(actions), in_keys=["pixels"], out_keys=["action"])


def test_a_student_that_acts_like_the_expert_is_not_corrected():
    seeds, checkpoint = [scene_seed("train", i) for i in (5, 6)], list_checkpoints("balance_reaching")[-1]
    truth = roll_out("balance_reaching", [Plan(seed, checkpoint) for seed in seeds])
    corrected = collect_corrections(student(truth["action"]), "balance_reaching", seeds)
    assert corrected.shape == (2, 120)
    for key in ("pixels", "goal", "action", "expert_action", ("dynamics", "velocity")):
        assert torch.equal(corrected[key], truth[key]), key
    assert not corrected["failed"].any()


def test_steps_after_a_failure_are_marked():
    """Full acceleration to one side drops the block; the expert would have done something else."""
    actions = torch.zeros(1, 120, 3)
    actions[:, :, 0] = 0.04 * torch.from_numpy(np.sign(np.sin(np.arange(120) / 4))).float()
    corrected = collect_corrections(student(actions), "balance_reaching", [scene_seed("train", 0)])
    failed = corrected["failed"][0, :, 0]
    assert not failed[0] and failed[-1] and failed.int().diff().min() == 0
    assert not torch.equal(corrected["action"], corrected["expert_action"])
