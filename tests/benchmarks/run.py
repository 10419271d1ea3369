"""The speed table of the README: every row times two things in one run and gives their ratio.

    uv run --extra benchmarks python tests/benchmarks/run.py            # all rows
    uv run --extra benchmarks python tests/benchmarks/run.py batch ppo  # some of them

Needs ``datasets/balance_reaching`` (``python recipes/collect.py``). Writes ``recipes/results/benchmarks.json``, where
rows that were not asked for stay as they are. The last rows of the table are ``recipes/results/main_job_time.json``.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import date
from pathlib import Path

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # as recipes do; before torch is there
import learning
import loading
import ppo
import simulation
import starting

from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.files import write_json

RESULTS = Path(__file__).parents[2] / "recipes" / "results" / "benchmarks.json"
MAIN_JOBS = RESULTS.with_name("main_job_time.json")
DATASET = "datasets/balance_reaching"
US, MS = 1e6, 1e3

# name: (what, against, unit, factor from seconds or rates to it, what the ratio should be, function of its sizes)
ROWS = {
    "control_step": (
        "control step, state", "bare loop of 50 x (set velocity, `space.step`)", "us", US, "<= 1.15", simulation.control_step
    ),
    "frame": ("control step with 64x64 frame", "the same without", "us", US, "<= 1.25", simulation.frame),
    "pusht": ("frames/s with pixels", "gym-pusht `pixels`", "1/s", 1, ">= 10", simulation.pusht),
    "batch": ("batched environment, a step of 64 worlds", "the worlds alone", "ms", MS, "<= 1.1", simulation.batch),
    "batch_threads": (
        "the same, its worlds on two threads", "the worlds alone, on one", "ms", MS, "",
        lambda **sizes: simulation.batch(**sizes, threads=2),
    ),
    "processes": ("two processes of 64 worlds", "one", "steps/s", 1, ">= 1.8", simulation.processes),
    "ppo": ("PPO, time to 97 % success", "Stable-Baselines3 on our Gymnasium id", "s", 1, "<= 0.33", ppo.ppo),
    "training": (
        "world-model training, frames/s", "the same in plain fp32, LSTM cells in a loop", "1/s", 1, ">= 6",
        lambda **sizes: learning.world_model_training(DATASET, **sizes),
    ),
    "training_decode_8": (
        "the same", "the same, decoding as few frames as we do", "1/s", 1, "",
        lambda **sizes: learning.world_model_training(DATASET, decode_all=False, **sizes),
    ),
    "windows": (
        "windows of 24 steps", "`DataLoader` over `LeRobotDataset`", "1/s", 1, ">= 100",
        lambda **sizes: loading.window_sampling(DATASET, **sizes),
    ),
    "to_tensordict": (
        "dataset to TensorDict, frames/s", "iterating `LeRobotDataset`", "1/s", 1, ">= 10",
        lambda **sizes: loading.to_tensordict(DATASET, **sizes),
    ),
    "evaluation": (
        "evaluation, an episode of 1,000", "one at a time through the Gymnasium id", "ms", MS, "<= 0.2",
        lambda **sizes: learning.evaluation(DATASET, **sizes),
    ),
    "import": ("`import dynmap_rl`", "`import gymnasium`", "s", 1, "ours < 0.3 s", starting.import_package),
    "help": ("`--help` of the slowest recipe", "`import torch`", "s", 1, "ours < 1 s", starting.show_help),
}  # fmt: skip


def markdown(results: dict, main_jobs: dict) -> str:
    """The table: its rows, and the main job's, which was timed apart on each machine and has nothing to be compared with."""
    lines = ["| what | against | ours | theirs | ratio | to reach |", "|---|---|---|---|---|---|"]
    for name, (what, against, unit, factor, goal, _) in ROWS.items():
        if row := results["rows"].get(name):
            ours, theirs = (f"{row[key] * factor:.3g} {unit}" for key in ("ours", "theirs"))
            lines.append(f"| {what} | {against} | {ours} | {theirs} | **{row['ratio']:.2f}** | {goal} |")
    for run in main_jobs["runs"]:
        found = f"{run['real_seconds'] / 60:.1f} min"
        if "SR" in run:
            low, high = run["SR_interval"]
            found += f", SR {run['SR']:.1f} % [{low:.1f}, {high:.1f}], PE {run['PE']:.1f} mm"
        what = f"main job from a fresh clone, `{run['command']}`, {run['processor']}"
        lines.append(f"| {what} |  | {found} |  |  | <= 12 min |")
    return "\n".join(lines)


def commit() -> str:
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()


def main(names: list[str]) -> None:
    if unknown := set(names) - set(ROWS):
        sys.exit(f"unknown rows {sorted(unknown)}; choose from {list(ROWS)}")
    results = read_json(RESULTS) if RESULTS.exists() else {"rows": {}}
    for name in names or ROWS:
        print(name, flush=True)
        if row := ROWS[name][-1]():
            results["rows"][name] = row | {"date": f"{date.today()}", "commit": commit()}
            results["machine"] = platform.platform()
            write_json(RESULTS, results)
    print(markdown(results, read_json(MAIN_JOBS)))


if __name__ == "__main__":
    main(sys.argv[1:])
