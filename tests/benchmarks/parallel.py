"""Jobs of a recipe in two processes, against one: recording, closed-loop episodes."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from timing import compare, seconds

from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.evaluation.protocol import evaluate
from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.runs import load_actor


def recording(episodes: int = 300) -> dict:
    """Seconds to record demonstrations as a dataset (and one held-out episode), start of the processes included."""

    def record(workers: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            sizes = {"episodes": episodes, "eval_episodes": 1, "workers": workers}
            return seconds(lambda: record_dataset(Path(folder) / "recording", **sizes))

    found = compare(lambda: record(2), lambda: record(1), repeats=1, warm=False)
    return found | {"episodes": episodes + 1}


def evaluation(episodes: int = 1000) -> dict:
    """Seconds to evaluate the shipped policy, start of the processes included."""
    torch.set_num_threads(1)
    actor, settings = load_actor("balance_reaching"), Evaluation(episodes=episodes, paper_episodes=0)

    def judge(workers: int) -> float:
        return seconds(lambda: evaluate(actor, "balance_reaching", settings, workers=workers))

    return compare(lambda: judge(2), lambda: judge(1), repeats=1, warm=False)
