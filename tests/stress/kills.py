"""Kill recipes at random moments, run the same command again, and compare with a run that was never killed.

    uv run python tests/stress/kills.py              # 20 kills of each of collect, expert, decoupled, tables
    uv run python tests/stress/kills.py expert -n 5

Every process of the recipe gets SIGKILL. In the end these must be the same: every number of a dataset and its metadata,
every weight, every metric but the wall-clock time, every row of every result. Finished shards, policies, runs and saved
updates must not be made again. The script ends with an error where anything differs; otherwise it writes the counts to
``recipes/results/measurements/kills.json``, where recipes that were not named stay as they are.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors.torch import load_file

from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

TESTS = Path(__file__).parents[1]
RECIPES, PRESETS = TESTS.parent / "recipes", TESTS / "presets"
RUN = "balance_reaching_obstacle_joint_none_recurrent"  # with the run whose world model it needs
TASKS, SMALL = ("balance_reaching", "balance_reaching_obstacle"), "--episodes 20 --eval_episodes 4"
COMMANDS = {
    "collect": "--episodes 60 --eval_episodes 10",
    "expert": f"--config_path {PRESETS}/expert.yaml --ppo.iterations 12 --ppo.checkpoint_every 2",
    "decoupled": f"--config_path {PRESETS}/decoupled.yaml --seeds 0,1 --world_model.updates 600",  # saved every 250
    "paper/tables": f"--presets {PRESETS} --only {RUN} --results results",
}
RESULTS = RECIPES / "results/measurements/kills.json"
LEFT_OUT = {"seconds", "command"}  # wall-clock time


def run(recipe: str, folder: Path, kill_after: float | None = None) -> bool:
    """Run a recipe; return whether it ended before it was killed."""
    command = [sys.executable, str(RECIPES / f"{recipe}.py"), *COMMANDS[recipe].split()]
    environment = {**os.environ, "TQDM_DISABLE": "1"}
    with open(folder.parent / f"{folder.name}.log", "a") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            code = process.wait(kill_after)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return False
    if code:
        raise SystemExit(f"{recipe} failed; see {log.name}")
    return True


def contents(folder: Path) -> dict[str, object]:
    """Return by its path everything that must be the same."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".safetensors":
            found[name] = {key: value.numpy().tobytes() for key, value in load_file(path).items()}
        elif path.name == "metrics.jsonl":
            found[name] = [plain(json.loads(line)) for line in path.read_text().splitlines()]
        elif (
            path.name in ("eval.json", "dynmap.json", "info.json", "stats.json")
            or path.parent.name == "results"
        ):
            found[name] = plain(json.loads(path.read_text()))
        elif path.suffix == ".parquet" and "data" in path.parts:
            found[name] = path.read_bytes()
    return found


def finished(folder: Path) -> dict[str, int]:
    """Return the times of files that a later run must leave alone, and the last saved update of every training."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if ".tmp" in name:
            continue
        if path.suffix == ".pt":
            state = torch.load(path, weights_only=True)
            found[name] = state["update"] if "update" in state else state["iteration"]
        elif path.name in ("eval.json", "trained.json", "episodes.json") or path.parent.name == "results":
            found[name] = path.stat().st_mtime_ns
    return found


def lost(before: dict[str, int], folder: Path) -> list[str]:
    """Return the files that were made again or are gone, except for shards of a dataset that is complete by now."""
    now = finished(folder)
    whole = {str(path.relative_to(folder).parents[1]) for path in folder.rglob("meta/dynmap.json")}
    names = [name for name in before if not any(name.startswith(f"{root}.parts/") for root in whole)]
    return [
        n for n in names if n not in now or (now[n] < before[n] if n.endswith(".pt") else now[n] != before[n])
    ]


def plain(value):
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items() if key not in LEFT_OUT}
    return [plain(item) for item in value] if isinstance(value, list) else value


def prepare(recipe: str, folder: Path) -> Path:
    """Make a folder for a recipe; that of tables gets small recordings, which it would otherwise make whole."""
    folder.mkdir()
    for task in TASKS if recipe == "paper/tables" else ():
        command = [sys.executable, str(RECIPES / "collect.py"), "--task", task, *SMALL.split()]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return folder


def torment(recipe: str, kills: int, folder: Path) -> dict[str, int | str]:
    name = recipe.replace("/", "_")
    whole = prepare(recipe, folder / f"{name}_whole")
    began = time.perf_counter()
    run(recipe, whole)
    duration = time.perf_counter() - began
    expected, ends, count, midway, runs = contents(whole), finished(whole), 0, 0, 0
    while count < kills:
        killed, runs = prepare(recipe, folder / f"{name}_killed_{runs}"), runs + 1
        kept, ended = {}, False
        while not ended:
            ended = run(recipe, killed, random.uniform(0, duration / 2) if count < kills else None)
            count += not ended
            if again := lost(kept, killed):
                raise SystemExit(f"{recipe}: after {count} kills these were made again: {', '.join(again)}")
            kept = finished(killed)
            midway += any(name.endswith(".pt") and kept[name] < ends.get(name, math.inf) for name in kept)
        found = contents(killed)
        differing = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
        if differing:
            raise SystemExit(f"{recipe}: after {count} kills these differ: {', '.join(differing)}")
    counts = {"kills": count, "runs": runs, "after_a_saved_state": midway, "files_the_same": len(expected)}
    print(f"{recipe}: {counts}", flush=True)
    return counts | {"arguments": COMMANDS[recipe].replace(f"{TESTS.parent}/", ""), "commit": find_commit()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recipes", nargs="*", default=list(COMMANDS))
    parser.add_argument("-n", "--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    random.seed(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        for recipe in arguments.recipes:
            found = torment(recipe, arguments.kills, Path(folder))
            write_json(RESULTS, (read_json(RESULTS) if RESULTS.exists() else {}) | {recipe: found})


if __name__ == "__main__":
    main()
