"""Train small models in each of three ways, in one process, under ``torchrun`` or by Ray.

torchrun --nproc_per_node 2 two_ranks.py --folder FOLDER
python two_ranks.py --folder FOLDER --compute.launcher ray --compute.ranks 2
"""

import os
import signal
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from small import CONSTANTS, make_episodes, make_model

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.training import loop
from dynmap_rl.training.joint import train_end_to_end, train_jointly
from dynmap_rl.training.settings import EndToEndTraining, JointTraining, WorldModelTraining
from dynmap_rl.training.world_model import train_world_model
from dynmap_rl.utils.cli import run_recipe
from dynmap_rl.utils.devices import RankedCompute
from dynmap_rl.utils.ranks import join_ranks, leave_ranks, rank, ranks
from dynmap_rl.utils.ray_train import train_by_ray

SIZES = {
    "updates": 20,
    "windows": 4,
    "window_steps": 5,
    "short_windows": 0,
    "augmentation": Augmentation.off(),
}
ALL = {"rgb_frames": 1000}  # no frames are drawn at random
WORLD_MODEL = WorldModelTraining("position", imagined=0, **ALL, **SIZES)


@dataclass(frozen=True)
class Config:
    folder: Path = Path("runs")
    windows: int = 4
    # Update in the training of the world model at which the last process dies.
    update: int = 0
    compute: RankedCompute = RankedCompute("cpu", threads=1)


def die_at(update: int) -> None:
    step, calls = loop.step, []

    def step_or_die(*arguments):
        calls.append(1)
        if len(calls) == update and rank() == ranks() - 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return step(*arguments)

    loop.step = step_or_die


def train(folder: Path, windows: int) -> None:
    episodes = make_episodes(5)
    settings = replace(WORLD_MODEL, windows=windows)
    train_world_model(make_model(), episodes, folder / "world_model", settings, save_every=1)
    some = replace(settings, labelled=0.5, beta_rgb=0.0, rgb_frames=WorldModelTraining.rgb_frames)
    train_world_model(make_model(), episodes, folder / "labelled", some, save_every=1)
    joint, end_to_end = JointTraining(**ALL, **SIZES), EndToEndTraining(**SIZES)
    for name, run, settings in (
        ("joint", train_jointly, joint),
        ("end_to_end", train_end_to_end, end_to_end),
    ):
        model = make_model()
        policy = make_policy(CONSTANTS, "recurrent", model, width=16)
        run(model, policy, episodes, folder / name, settings, save_every=1)


def main(config: Config) -> None:
    if config.compute.launcher == "ray":
        return train_by_ray(main, config, sys.argv)
    torch.set_num_threads(1)
    # Gradients in bfloat16 are rounded, and those of halves of a batch otherwise than those of the whole.
    loop.mixed_precision = lambda device: torch.autocast("cpu", enabled=False)
    join_ranks("cpu")
    if config.update:
        die_at(config.update)
    train(config.folder, config.windows)
    if not leave_ranks():
        print(f"{sys.argv[0]}: done")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
