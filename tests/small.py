"""Small models, episodes and settings for tests of training."""

from __future__ import annotations

import os
import time
from pathlib import Path

import torch
from tensordict import TensorDict

from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.training.settings import EndToEndTraining, JointTraining, PolicyTraining, WorldModelTraining

CONSTANTS = {
    "action": {"low": [-0.02, -0.02, -0.05], "high": [0.02, 0.02, 0.05]},
    "goal": {"low": [0.0, 0.0], "high": [1.0, 1.0]},
    "position": {"low": [0.0] * 6, "high": [1.0] * 6},
}
SIZES = {"updates": 6, "windows": 2, "window_steps": 5}
WORLD_MODEL = WorldModelTraining(supervision="position", rgb_frames=2, learning_rate=1e-3, **SIZES)
POLICY = PolicyTraining(updates=4, batch=2, learning_rate=1e-3)
JOINT = JointTraining(rgb_frames=2, **SIZES)
END_TO_END = EndToEndTraining(**SIZES)


class Stop(Exception):
    """Raised in the place of a kill."""


def make_episodes(count: int = 3, steps: int = 12) -> dict[str, TensorDict]:
    """Return random episodes ``[count, steps]``, the same as ``train`` and ``eval``."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.randint(0, 256, (count, steps, 3, 64, 64), dtype=torch.uint8, generator=generator)
    values = {
        "pixels": pixels,
        "action": 0.01 * torch.randn(count, steps, 3, generator=generator),
        "goal": torch.rand(count, steps, 2, generator=generator),
        "dynamics": {q: torch.rand(count, steps, 6, generator=generator) for q in DYNAMICS},
    }
    return dict.fromkeys(("train", "eval"), TensorDict(values, [count, steps]))


def make_model(latent_size: int = 16):
    """Return a small world model, always with the same weights."""
    torch.manual_seed(0)
    return make_world_model(CONSTANTS, ("position",), latent_size=latent_size, hidden_size=24)


def load():
    """Return episodes and constants, as the loaders of datasets do."""
    return make_episodes(), CONSTANTS


def judge(world_model, policy) -> dict:
    """Stand in for an evaluation; a function of a module, so that other processes can import it."""
    return {"parameters": sum(p.numel() for p in policy.parameters())}


def read_weights(folder: Path) -> dict[str, bytes]:
    """Return the content of all weights in a folder by their paths."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.safetensors")}


def exit_elsewhere(num_envs, own):
    """Make an environment in the process ``own``, and end any other one."""
    if os.getpid() != own:
        os._exit(1)
    time.sleep(1)  # until the other process has taken its share
    return DynmapBatchedEnv("balance_reaching", num_envs, control="acceleration")
