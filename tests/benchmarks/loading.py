"""Datasets: windows for training, and everything into memory."""

from __future__ import annotations

import torch
from timing import compare, seconds

from dynmap_rl.data import load_dataset, sample_windows

WINDOWS, STEPS = 16, 24


def _lerobot(dataset: str, **arguments):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/benchmark", root=dataset, **arguments)


def window_sampling(dataset: str, batches: int = 5) -> dict:
    """Windows a second, against a ``DataLoader`` with two workers over ``LeRobotDataset`` with delta timestamps."""
    episodes = load_dataset(dataset, "train").select("pixels", "action", "goal", "dynamics")
    generator = torch.Generator().manual_seed(0)
    columns = ["observation.images.front", "action", "dynamics.position", "dynamics.velocity"]
    times = [t / 20 for t in range(STEPS)]
    dataset = _lerobot(dataset, delta_timestamps=dict.fromkeys(columns, times))
    loader = torch.utils.data.DataLoader(dataset, WINDOWS, shuffle=True, num_workers=2)

    def ours():
        many = 20 * batches

        def run():
            for _ in range(many):  # none is kept, as in training
                sample_windows(episodes, WINDOWS, STEPS, generator)

        return many * WINDOWS / seconds(run)

    def theirs():
        iterator = iter(loader)
        next(iterator)  # the workers are up
        return batches * WINDOWS / seconds(lambda: [next(iterator) for _ in range(batches)])

    return compare(ours, theirs, repeats=3)


def to_tensordict(dataset: str, count: int = 3000) -> dict:
    """Frames a second into one TensorDict, against iterating ``LeRobotDataset``."""
    frames = load_dataset(dataset).numel()
    lerobot = _lerobot(dataset)

    def theirs():
        return count / seconds(lambda: [lerobot[i] for i in range(count)])

    return compare(lambda: frames / seconds(lambda: load_dataset(dataset)), theirs, repeats=2)
