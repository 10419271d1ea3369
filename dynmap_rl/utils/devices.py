"""Devices, threads and seeds. Torch is imported where it is used, so that ``--help`` is quick."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .cluster import check_launcher
from .settings import check_at_least, check_choice

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True)
class Compute:
    """Device and cores of a run; neither is part of its settings, and a run may resume with others."""

    # cpu, cuda, or auto: the GPU where PyTorch finds one.
    device: str = "auto"
    # CPU cores: threads of one training or evaluation, or processes of one thread each, for several seeds or batches.
    threads: int = 2

    def __post_init__(self):
        check_choice(self, "device", ("auto", "cpu", "cuda"))
        check_at_least(self, 1, "threads")


@dataclass(frozen=True)
class RankedCompute(Compute):
    """Device and cores of a training by one process or, on a Ray cluster, by several (ranks)."""

    # local (also under torchrun), or ray: ranks on a Ray cluster, with threads CPUs each, and a GPU each with cuda.
    launcher: str = "local"
    # Processes that train one model, with the launcher ray.
    ranks: int = 1

    def __post_init__(self):
        super().__post_init__()
        check_launcher(self.launcher)
        check_at_least(self, 1, "ranks")
        if self.launcher == "local" and self.ranks > 1:
            raise ValueError(
                "--compute.ranks has no effect with --compute.launcher local; choose ray, or use torchrun"
            )


def choose_device(name: str) -> torch.device:
    """Return the device of a name; ``auto`` is the GPU where PyTorch finds one.

    Raises:
        ValueError: PyTorch does not find the device.
    """
    import torch

    gpu = torch.cuda.is_available()
    if name == "cuda" and not gpu:
        raise ValueError("device cuda: PyTorch finds no GPU; use cpu, or install a CUDA build of PyTorch")
    return torch.device("cuda" if gpu and name != "cpu" else "cpu")


def device_name(name: str) -> str:
    """Return the device of :func:`choose_device` for a result: ``cpu``, or the product name of the GPU."""
    import torch

    device = choose_device(name)
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def seed_everything(seed: int) -> None:
    """Seed the generators of Python, NumPy and torch."""
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
