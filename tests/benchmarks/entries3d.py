"""Measure which entries of the dynamics world models of MuJoCo tasks have learned.

    MUJOCO_GL=egl uv run --extra mujoco python tests/benchmarks/entries3d.py RUN [RUN ...]

``RUN`` is a folder of ``recipes/decoupled.py --task mujoco:...``, whose dataset is there too. For every entry, the mean
absolute error of the prediction one step ahead on held-out demonstrations is given beside those of two simple predictions,
the best constant and the value one step earlier. Writes ``recipes/results/measurements/entries3d.json``, where tasks that
were not named stay as they are.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from dynmap_rl.data import load_demonstrations
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.evaluation.errors import naive_errors, prediction_errors
from dynmap_rl.modules.checkpoints import load_world_model
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements/entries3d.json"


def measure(run: Path) -> tuple[str, dict]:
    """Return the task of a run, and the errors of every entry."""
    config = read_json(run / "config.json")
    task = get_task(config["task"])
    episodes = load_demonstrations(config["dataset"] or f"datasets/{task.name}")[0]["eval"]
    world_model = load_world_model(run / "world_model")
    errors = prediction_errors(world_model, episodes, by_entry=True)
    entries = {}
    for quantity, names in (("position", task.layout.position), ("velocity", task.layout.velocity)):
        naive = naive_errors(episodes["dynamics", quantity])
        for i, name in enumerate(names):
            found = {"error": errors[f"error_{quantity}_{i}"]} | {key: row[i] for key, row in naive.items()}
            entries[f"{quantity} {name}"] = {key: round(value, 5) for key, value in found.items()}
    print(f"{config['task']}, error / constant (value one step earlier / constant)")
    for name, row in entries.items():
        if row["constant"] > 1e-4:  # what rests has no scale
            print(
                f"  {name:28} {row['error'] / row['constant']:.2f} ({row['earlier'] / row['constant']:.2f})"
            )
    return config["task"], {
        "run": run.name,
        "trained_by": read_json(run / "eval.json")["commit"],
        "entries": entries,
    }


def main() -> None:
    """Measure every run, and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    runs = parser.parse_args().runs
    torch.set_num_threads(1)
    result = read_json(RESULTS) if RESULTS.exists() else {"tasks": {}}
    result["tasks"] |= dict(measure(run) for run in runs)
    write_json(RESULTS, result | {"command": command_line(sys.argv), "commit": find_commit()})
    print(f"written: {RESULTS}")


if __name__ == "__main__":
    main()
