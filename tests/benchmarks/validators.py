"""What validators of LeRobot datasets that others wrote say of ours.

    python tests/benchmarks/validators.py --bin robovet/bin --bin rdq/bin --bin lerobot-doctor/bin

Each is installed by ``pip install robovet``, ``rdq`` and ``lerobot-doctor``, in an environment of its own, whose ``bin``
folders are named; on datasets/TASK of the three tasks. Writes ``recipes/results/measurements/validators.json``.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements"
COMMANDS = {
    "robovet": ["doctor", "DATASET"],
    "rdq": ["check", "DATASET", "--fail-under", "100"],
    "lerobot-doctor": ["check", "DATASET", "--fail-on", "fail"],
}
SAID = re.compile(r"\d+ (?:fail|pass)|Score|WARN|ERROR|FAIL|^\s*- |CLEAN", re.I)


def validate(name: str, dataset: Path) -> dict:
    """Its exit code, and the lines that say more than that a check has passed."""
    command = [name, *(str(dataset) if part == "DATASET" else part for part in COMMANDS[name])]
    done = subprocess.run(command, capture_output=True, text=True)
    lines = [line.strip() for line in done.stdout.splitlines()]
    said = [line for line in lines if SAID.search(line) and not line.startswith(("PASS", "[PASS]"))]
    return {"command": " ".join(command), "exit": done.returncode, "said": said}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--bin", action="append", default=[], help="folder to look for the commands in, first"
    )
    os.environ["PATH"] = os.pathsep.join([*parser.parse_args().bin, os.environ["PATH"]])
    if missing := [name for name in COMMANDS if not shutil.which(name)]:
        raise SystemExit(f"not found: {', '.join(missing)}; install them, and name their folders with --bin")
    found = {}
    for task in TASKS:
        found[task] = {name: validate(name, Path("datasets") / task) for name in COMMANDS}
        for name, result in found[task].items():
            print(f"{task}, {name}: exit {result['exit']}", *result["said"], sep="\n  ", flush=True)
    write_json(
        RESULTS / "validators.json", found | {"command": command_line(sys.argv), "commit": find_commit()}
    )


if __name__ == "__main__":
    main()
