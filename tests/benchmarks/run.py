"""Time pairs of things in one run and write the tables of tests/benchmarks/README.md.

    uv run --extra benchmarks python tests/benchmarks/run.py            # all rows
    uv run --extra benchmarks python tests/benchmarks/run.py batch ppo  # some of them
    uv run --extra benchmarks python tests/benchmarks/run.py --write    # only the page, from the stored numbers

Needs ``datasets/balance_reaching`` (``python recipes/collect.py``). Writes
``recipes/results/measurements/benchmarks.json``, where rows that were not named stay as they are, and the page.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import date
from pathlib import Path

os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # as recipes do; before torch is imported
import deploying
import learning
import loading
import parallel
import ppo
import ranks
import simulation
import starting

from dynmap_rl.utils.files import read_json, write_bytes, write_json

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements" / "benchmarks.json"
MAIN_JOBS = RESULTS.with_name("main_job_time.json")
MEMORY, SOAK = RESULTS.with_name("memory.json"), RESULTS.with_name("soak.json")
SIZES, UPDATES = RESULTS.with_name("dataset_size.json"), RESULTS.with_name("updates_cpu.json")
LATENCY = RESULTS.with_name("realtime.json")
PAGE = Path(__file__).with_name("README.md")
START, END = "<!-- written by tests/benchmarks/run.py --write -->", "<!-- end -->"
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
    "processes": ("two processes of 64 worlds", "one", "steps/s", 1, ">= 1.8", simulation.processes),
    "ppo": ("PPO, time to 97 % success", "Stable-Baselines3 on our Gymnasium id", "s", 1, "<= 0.5", ppo.ppo),
    "training": (
        "training with plain CNNs, frames/s", "the same in plain fp32, LSTM cells in a loop", "1/s", 1, ">= 6",
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
        "dataset to TensorDict, mapped from its cache, frames/s", "iterating `LeRobotDataset`", "1/s", 1, ">= 10",
        lambda **sizes: loading.to_tensordict(DATASET, **sizes),
    ),
    "evaluation": (
        "evaluation, an episode of 1,000", "one at a time through the Gymnasium id", "ms", MS, "<= 0.2",
        lambda **sizes: learning.evaluation(DATASET, **sizes),
    ),
    "recording": ("recording 300 demonstrations, two processes", "one", "s", 1, "ours < 45 s", parallel.recording),
    "evaluating": ("evaluation of 1,000 episodes, two processes", "one", "s", 1, "ours < 20 s", parallel.evaluation),
    "ranks": ("update of a world model, two processes under `torchrun`", "one process with two threads", "s", 1, "", ranks.two_ranks),
    "onnx": ("control step in onnxruntime, one core", "the same in PyTorch", "ms", MS, "", deploying.onnx),
    "import": ("`import dynmap_rl`", "`import gymnasium`", "s", 1, "ours < 0.3 s", starting.import_package),
    "help": ("`--help` of the slowest recipe", "`import torch`", "s", 1, "ours < 1 s", starting.show_help),
}  # fmt: skip


def speed_table(results: dict) -> str:
    """Return the rows that have been timed as a table."""
    lines = ["| what | against | ours | theirs | ratio | goal |", "|---|---|---|---|---|---|"]
    for name, (what, against, unit, factor, goal, _) in ROWS.items():
        if row := results["rows"].get(name):
            ours, theirs = (f"{three_digits(row[key] * factor)} {unit}" for key in ("ours", "theirs"))
            lines.append(f"| {what} | {against} | {ours} | {theirs} | **{row['ratio']:.2f}** | {goal} |")
    return "\n".join(lines)


def three_digits(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{float(f'{value:.3g}'):,.0f}"


def main_job_table(main_jobs: dict) -> str:
    """Return the times of the main job, which was timed once on each machine."""
    lines = [
        "| `recipes/decoupled.py` from a fresh clone | commit | minutes | SR | PE |",
        "|---|---|---|---|---|",
    ]
    for run in main_jobs["runs"]:
        low, high = run["SR_interval"]
        found = f"{run['SR']:.1f} % [{low:.1f}, {high:.1f}] | {run['PE']:.1f} mm"
        lines.append(f"| {run['processor']} | `{run['commit']}` | {run['real_seconds'] / 60:.1f} | {found} |")
    return "\n".join(lines)


def memory_table(memory: dict) -> str:
    """Return the largest memory of every recipe, all its processes together."""
    lines = [f"| recipe | {memory['unit']} |", "|---|---|"]
    return "\n".join(lines + [f"| `{name}` | {peak:.2f} |" for name, peak in memory["peak"].items()])


def size_table(sizes: dict) -> str:
    """Return load times, rates of windows and memory by the size of the dataset; later loads after the slash."""
    lines = [
        "| episodes | parquet files | decoded, on disk | load (s) | windows/s | private memory (MB) |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in sizes["rows"].items():
        cold, warm = row["cold"], row["warm"]
        what = f"{row['episodes']:,}" + ("" if name.isdigit() else ", two cameras of 128 x 128")
        disk = f"{row['files_MB']:,.0f} MB | {row['cache_MB'] / 1000:,.1f} GB"
        load = f"{cold['load_s']:.1f} / {warm['load_s']:.2f}"
        rate = f"{cold['windows_per_s']:,.0f} / {warm['windows_per_s']:,.0f}"
        lines.append(
            f"| {what} | {disk} | {load} | {rate} | {cold['private_MB']:.0f} / {warm['private_MB']:.0f} |"
        )
    if memory := next((r["warm"].get("windows_per_s_in_memory") for r in sizes["rows"].values()), None):
        lines.append(f"\n350 episodes that are held in memory give {memory:,.0f} windows/s.")
    return "\n".join(lines)


def updates_table(found: dict) -> str:
    """Return what an update of a world model takes, and what it spends the time on."""
    families = list(found["rows"][0]["breakdown"])
    lines = [
        f"| precision, windows | ms | frames/s | share of peak | {' | '.join(families)} |",
        "|---" * (4 + len(families)) + "|",
    ]
    for row in found["rows"]:
        precision = "bfloat16" if row["mixed"] else "float32"
        parts = " | ".join(f"{100 * row['breakdown'].get(family, 0):.0f} %" for family in families)
        share = f"{100 * row['share_of_convolution_peak']:.0f} %"
        lines.append(
            f"| {precision}, {row['windows']} | {row['ms']:.0f} | {row['frames_per_s']:,.0f} | {share} | {parts} |"
        )
    peaks = " and ".join(
        f"{peak / 1e9:.0f} GFLOP/s in {name}" for name, peak in found["convolution_peak_flops"].items()
    )
    return (
        "\n".join(lines)
        + f"\n\nThe peak, the fastest of a few large convolutions, is {peaks} ({found['device']})."
    )


def latency_table(found: dict) -> str:
    """Return the time from a frame to its action on one core."""
    names = {
        "actor": "shipped actor",
        "onnx": "the same in onnxruntime",
        "delayed": "the same on frames 300 ms old, rolled forward",
        "act": "ACT, chunks of 20, a new one after 10 steps",
        "diffusion": "Diffusion Policy, 10 DDIM steps, a new chunk after 8 steps",
        "server": "actions of a policy in another process, which works 200 ms on a frame",
    }
    lines = [
        "| control step on one core | loop | p50 (ms) | p99 (ms) | worst (ms) | SR |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in found["rows"].items():
        loop, text = "20 Hz" if row["paced"] else "fast", name.removesuffix("_paced")
        times = " | ".join(f"{row['latency_ms'][part]:.1f}" for part in ("p50", "p99", "worst"))
        success = "" if text in ("act", "diffusion") else f"{row['SR']:.0f} % of {row['episodes']}"
        lines.append(f"| {names.get(text, f'`{text}`')} | {loop} | {times} | {success} |")
    return "\n".join(lines)


def soak_text(soak: dict) -> str:
    """Return the held memory at the beginning and the end of the soak test."""
    first, last = soak["held_mb"][0], soak["held_mb"][-1]
    steps, episodes = f"{soak['steps']:,} control steps with frames", f"{soak['episodes']:,} episodes"
    return f"Held memory over {steps} ({episodes}): {first} MB after the first tenth, {last} MB at the end."


def page(text: str) -> str:
    """Return the text of the page with its tables written anew from the stored measurements."""
    tables = (
        speed_table(read_json(RESULTS)),
        main_job_table(read_json(MAIN_JOBS)),
        memory_table(read_json(MEMORY)),
        size_table(read_json(SIZES)),
        updates_table(read_json(UPDATES)),
        latency_table(read_json(LATENCY)),
        soak_text(read_json(SOAK)),
    )
    before, _, rest = text.partition(START)
    _, _, after = rest.partition(END)
    return before + "\n\n".join([START, *tables, END]) + after


def commit() -> str:
    return subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True
    ).stdout.strip()


def main(names: list[str]) -> None:
    """Time the rows and write the page; ``--write`` in the place of names writes the page alone."""
    if names == ["--write"]:
        return write_bytes(PAGE, page(PAGE.read_text()).encode())
    if unknown := set(names) - set(ROWS):
        sys.exit(f"unknown rows {sorted(unknown)}; choose from {list(ROWS)}")
    results = read_json(RESULTS) if RESULTS.exists() else {"rows": {}}
    for name in names or ROWS:
        print(name, flush=True)
        if row := ROWS[name][-1]():
            results["rows"][name] = row | {"date": f"{date.today()}", "commit": commit()}
            results["machine"] = platform.platform()
            write_json(RESULTS, results)
    write_bytes(PAGE, page(PAGE.read_text()).encode())
    print(speed_table(results))


if __name__ == "__main__":
    main(sys.argv[1:])
