"""A control step in onnxruntime, against PyTorch."""

from __future__ import annotations

import tempfile
import time

import numpy as np
import torch
from tensordict import TensorDict
from timing import compare

from dynmap_rl.integrations.onnx import OnnxActor, export_to_onnx
from dynmap_rl.runs import load_actor


def onnx(steps: int = 100) -> dict[str, float]:
    """Seconds of a control step (encoder, policy and transition) on one thread, on one frame."""
    torch.set_num_threads(1)
    pixels, goal = np.zeros((1, 3, 64, 64), np.uint8), np.zeros((1, 2), np.float32)
    actor = load_actor("balance_reaching").eval()

    def theirs() -> float:
        td = TensorDict({}, [1])
        began = time.perf_counter()
        with torch.no_grad():
            for _ in range(steps):
                td.set("pixels", torch.from_numpy(pixels)).set("goal", torch.from_numpy(goal))
                td = actor(td)["next"]
        return (time.perf_counter() - began) / steps

    with tempfile.TemporaryDirectory() as folder:
        exported = OnnxActor(export_to_onnx("balance_reaching", folder))

        def ours() -> float:
            began = time.perf_counter()
            for _ in range(steps):
                exported.act(pixels, goal)
            return (time.perf_counter() - began) / steps

        return compare(ours, theirs)
