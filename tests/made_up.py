"""Made-up results of runs, as files of a folder."""

from __future__ import annotations

import json
from pathlib import Path

from dynmap_rl.paper.cells import Key, Run, list_runs

TASK = "balance_reaching"


def runs_of(key: Key) -> list[Run]:
    """Return the runs of a cell."""
    return [run for run in list_runs() if run.cell == key]


def flags(ones: int, count: int = 40) -> str:
    """Return a text of ``count`` flags, of which the first ones are 1."""
    return "1" * ones + "0" * (count - ones)


def write(
    folder: Path, row: str, *successes: int, training="decoupled", policy="recurrent", task=TASK, **rows
):
    """Write the results of a cell: a number of successes in 40 scenes for each world model.

    Args:
        folder: folder of the results.
        row: row of the cell.
        successes: for each world model; all of its three policies have the same.
        training: training of the cell.
        policy: kind of the policies.
        task: task of the policies.
        rows: other outcomes of the episodes; or ``commit`` or ``device``; or ``first``, the number of the first world model.
    """
    origin = {"commit": rows.pop("commit", "abc"), "device": rows.pop("device", "cpu")}
    first = rows.pop("first", 0)
    made = [make_rows(number, **rows) for number in successes]
    runs = runs_of((task, training, policy, row))
    names = [f"{training} {row} {first + number}" for number in range(len(made))]
    if len(runs) == 1:  # a world model for each seed
        seeds = zip(made, names, strict=True)
        results = [
            [{"test": {"rows": one}, "paper": {"rows": one}, "world_model_sha256": n} for one, n in seeds]
        ]
    else:
        results = [[{"test": {"rows": one}, "paper": {"rows": one}}] * 3 for one in made]
    folder.mkdir(parents=True, exist_ok=True)
    for number, (run, seeds) in enumerate(zip(runs, results, strict=False)):
        facts = {"task": task, "policy": policy, "row": row, "command": "python x.py", **origin}
        facts |= {"world_model_sha256": None if len(runs) == 1 else names[number], "results": seeds}
        (folder / f"{run.name}.json").write_text(json.dumps(facts))


def make_rows(successes: int, count: int = 40, **rows) -> dict:
    """Return the columns of ``count`` episodes."""
    rows = {"dropped": flags(0), "touched": flags(0), "position_error": [0.01] * count} | rows
    return {"first_scene_seed": 7, "success": flags(successes, count), **rows}
