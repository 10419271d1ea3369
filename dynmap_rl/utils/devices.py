"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results.
The same command on the same folder resumes it. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def choose_device(name: str) -> torch.device:
    """The device of a name; ``auto`` is the GPU where there is one.

    Raises:
        ValueError: there is no such device here.
    """
    import torch

    gpu = torch.cuda.is_available()
    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"--device is auto, cpu or cuda, not {name!r}")
    if name == "cuda" and not gpu:
        raise ValueError(
            "--device cuda: PyTorch finds no GPU here; leave it out, or install a CUDA build of PyTorch"
        )
    return torch.device("cuda" if gpu and name != "cpu" else "cpu")


def seed_everything(seed: int) -> None:
    """Seed Python, NumPy and torch."""
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)
