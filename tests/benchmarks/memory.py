"""Measure the largest memory that each recipe needs, with all its processes, in its full size.

    uv run python tests/benchmarks/memory.py              # all recipes
    uv run python tests/benchmarks/memory.py probe play   # some of them

Needs ``datasets/balance_reaching`` (``python recipes/collect.py``); ``generalize`` records another. Data, batches,
models and evaluations have their full sizes; there are only fewer optimiser steps, which all need the same memory. The
cells of ``paper/tables.py`` are runs of these recipes. Shared pages count once (proportional set size, so Linux only).
Writes ``recipes/results/measurements/memory.json``, where recipes that were not named stay as they are.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

RECIPES = Path(__file__).parents[2] / "recipes"
RESULTS = RECIPES / "results/measurements/memory.json"
DATASET = Path("datasets/balance_reaching")
FEW = ["--world_model.updates", "30"]
TRAINING = ["--training.updates", "30"]
POLICY = ["--policy.updates", "30"]
SHIPPED = ["--pretrained", "balance_reaching"]
COMMANDS = {
    "collect": ["--output", "collected"],
    "expert": ["--run", "expert", "--ppo.iterations", "3"],
    "decoupled": ["--run", "decoupled", *FEW, *POLICY],
    "generalize": ["--task", "bin_dropping", *SHIPPED, "--run", "generalize", *POLICY],
    "joint": ["--run", "joint", *TRAINING],
    "end_to_end": ["--run", "end_to_end", *TRAINING],
    "evaluate": [],
    "latent_ppo": [*SHIPPED, "--run", "latent_ppo", "--ppo.iterations", "3"],
    "probe": ["--runs", "balance_reaching"],
    "add_dynamics": ["--dataset", str(DATASET), "--source", "tracks", "--replace", "--output", "tracked"],
    "paper/figures": ["--only", "fig2,fig4"],
    "play": ["--policy", "balance_reaching", "--steps", "240", "--gif", "film.gif"],
}


def peak(command: list[str], folder: str) -> float:
    """Run a command and return the largest memory (GB) of it and its children."""
    environment = {"SDL_VIDEODRIVER": "dummy"} | os.environ  # a window needs no screen
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    most = 0
    while process.poll() is None:
        most = max(most, sum(map(held, family(process.pid))))
        time.sleep(0.5)
    if process.returncode:
        raise OSError(f"{' '.join(command)} failed")
    return most / 1e6


def family(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        return []
    return [pid, *(one for child in children for one in family(int(child)))]


def held(pid: int) -> int:
    """Return the proportional set size (kB) of a process."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:  # the process has just ended
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith("Pss:")), 0)


def main(names: list[str]) -> None:
    if unknown := set(names) - set(COMMANDS):
        sys.exit(f"unknown recipes {sorted(unknown)}; choose from {list(COMMANDS)}")
    if not DATASET.exists():
        sys.exit(f"there is no {DATASET}; record it with python recipes/collect.py")
    found = read_json(RESULTS)["peak"] if RESULTS.exists() else {}
    for name in names or COMMANDS:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder) / DATASET
            link.parent.mkdir()
            link.symlink_to(DATASET.resolve())
            found[name] = round(
                peak([sys.executable, str(RECIPES / f"{name}.py"), *COMMANDS[name]], folder), 2
            )
        print(f"{name}: {found[name]} GB", flush=True)
        facts = {"command": command_line(sys.argv), "commit": find_commit()}
        write_json(RESULTS, {"unit": "GB", "peak": found} | facts)


if __name__ == "__main__":
    main(sys.argv[1:])
