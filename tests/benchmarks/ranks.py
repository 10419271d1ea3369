"""Training of a world model by two processes with a thread each, against one process with two threads.

Run under ``torchrun`` or alone, the script prints the seconds of an update, which :func:`two_ranks` reads.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from timing import compare, seconds
from updates import CONSTANTS, make_episodes

from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.training.settings import WorldModelTraining
from dynmap_rl.training.world_model import train_world_model
from dynmap_rl.utils.ranks import join_ranks, leave_ranks, rank

UPDATES = 10, 40  # of two trainings, whose difference has neither start nor end


def two_ranks(updates: tuple[int, int] = UPDATES, repeats: int = 3) -> dict:
    """Return the seconds of an update; ``one_thread`` is that of one process with one thread."""

    def run(*launcher: str, threads: int = 1) -> float:
        command = [
            sys.executable,
            *launcher,
            __file__,
            "--threads",
            f"{threads}",
            "--updates",
            *map(str, updates),
        ]
        return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])

    def ours() -> float:
        return run("-m", "torch.distributed.run", "--nproc_per_node", "2")

    found = compare(ours, lambda: run(threads=2), repeats=repeats, warm=False)
    return found | {"one_thread": run()}


def train(updates: int, episodes: dict) -> None:
    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position", "velocity"))
    settings = WorldModelTraining(updates=updates, short_windows=0)
    with tempfile.TemporaryDirectory() as folder:
        train_world_model(model, episodes, Path(folder), settings)


def main() -> None:
    """Print the seconds of an update of ``recipes/decoupled.py``, on random frames."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--updates", type=int, nargs=2, default=UPDATES)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    join_ranks("cpu")
    episodes = {"train": make_episodes(), "eval": make_episodes(2)}
    few, many = (seconds(lambda count=count: train(count, episodes)) for count in options.updates)
    if not rank():
        print((many - few) / (options.updates[1] - options.updates[0]))
    leave_ranks()


if __name__ == "__main__":
    main()
