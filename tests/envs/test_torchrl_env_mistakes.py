"""Bad input of the batched TorchRL environment: errors that say what is wrong."""

import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv


@pytest.mark.parametrize("seeds", [torch.arange(2), torch.zeros(2, 2, dtype=torch.int64), [0, 1, 2], 0])
def test_every_world_has_its_scene_s_seed(seeds):
    shape = re.escape(str(tuple(np.shape(seeds))))
    with pytest.raises(ValueError, match=f"scene_seed .*got {shape}"):
        DynmapBatchedEnv(num_envs=4).reset(scene_seed=seeds)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"num_envs": 0}, "num_envs must be at least 1"),
        ({"control": "nope"}, "control .* 'nope'"),
        ({"task": "nope"}, "task .* 'nope'"),
    ],
)
def test_wrong_argument_raises(arguments, message):
    with pytest.raises(ValueError, match=message):
        DynmapBatchedEnv(**arguments)


def test_invalid_action_raises():
    env = DynmapBatchedEnv(num_envs=2)
    with pytest.raises(ValueError, match="3 finite numbers"):
        env.step(env.reset().set("action", torch.full((2, 3), torch.nan)))


def test_a_part_of_the_worlds_cannot_begin_alone():
    env = DynmapBatchedEnv(num_envs=2)
    with pytest.raises(RuntimeError, match="reset all worlds first"):
        env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))


def test_what_a_reset_does_not_know_is_refused():
    env = DynmapBatchedEnv(num_envs=2)
    with pytest.raises(RuntimeError, match="call reset first"):
        env.step(TensorDict({"action": torch.zeros(2, 3)}, [2]))
    with pytest.raises(TypeError, match="options"):
        env.reset(options={"goal_x": 0.7})
    with pytest.raises(ValueError, match="integers"):
        env.reset(scene_seed=torch.tensor([0.5, 1.5]))
    with pytest.raises(ValueError, match="scene_seed .*at least 0"):
        env.reset(scene_seed=torch.tensor([0, -1]))


def test_a_program_that_leaves_worlds_behind_ends_in_silence():
    code = (
        "import dynmap_rl\nfrom dynmap_rl.envs import DynmapBatchedEnv\n"
        "env = DynmapBatchedEnv('balance_reaching', 3)\ntd = env.rollout(2)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
