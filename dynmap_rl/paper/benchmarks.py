"""Cells of the grid of MuJoCo tasks, and its tables."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path
from statistics import fmean

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import mean_gap, shared_interval, summarize
from dynmap_rl.reporting.media import choose_episodes
from dynmap_rl.utils.files import read_json

from .cells import Run
from .results import count_devices, read_on_same_scenes
from .tables import cause_table, commits_text, devices_text, gap_text, join_table

TASKS = "FetchPush", "FetchSlide", "PlateSlide", "Soccer"
SEEDS = 0, 1, 2  # of weights and batches, of world models and policies
HAND = {"columns": [0, 1, 2]}  # its recorded positions
DERIVED = {  # rows whose dynamics need no simulator: name of their dataset, and how its columns are derived
    "RGB+[P+V] of the hand": ("hand", HAND),
    "RGB+[P+V], tracked": ("tracks", {"source": "tracks", "objects": 2}),
    "RGB+[P+V], hand and color": ("color", HAND | {"source": "state,tracks", "point": True}),
}
FRAMES = {  # rows with other frames: arguments of the task
    "RGB+[P+V], 96 pixels": ":image_size=96",
    "RGB+[P+V], two cameras": ":cameras=2",
}
COLORS = {"FetchPush": {"colors": ["#1c1c1c"], "threshold": 24}}  # of the object, where it has one of its own
SUPERVISED = "decoupled", ("--world_model.supervision", "position,velocity")
METHODS = {  # by the row of the table: recipe and its options
    "Only-RGB": ("decoupled", ("--world_model.supervision", "none")),
    "RGB+[P]": ("decoupled", ("--world_model.supervision", "position")),
    "RGB+[P+V]": SUPERVISED,
    **dict.fromkeys(DERIVED, SUPERVISED),
    "RGB+[P+V], ResNet-18": ("decoupled", ("--world_model.architecture", "resnet18")),
    "RGB+[P+V], ViT": ("decoupled", ("--world_model.architecture", "vit")),
    **dict.fromkeys(FRAMES, SUPERVISED),
    "RGB+[P+V], Joint": ("joint", ()),
    "End-to-End": ("end_to_end", ()),
    "ACT": ("baseline", ("--policy", "act")),
    "Diffusion Policy": ("baseline", ("--policy", "diffusion")),
}
GAPS = (  # of which the page gives intervals
    ("RGB+[P]", "Only-RGB"),
    ("RGB+[P+V]", "Only-RGB"),
    ("RGB+[P+V]", "RGB+[P]"),
    ("RGB+[P+V]", "RGB+[P+V], hand and color"),
    ("RGB+[P+V], hand and color", "Only-RGB"),
    ("RGB+[P+V], 96 pixels", "RGB+[P+V]"),
    ("RGB+[P+V]", "End-to-End"),
    ("End-to-End", "Only-RGB"),
    ("RGB+[P+V]", "ACT"),
    ("End-to-End", "ACT"),
    ("ACT", "Diffusion Policy"),
)
UPDATES = {  # of world models and policies, in the place of the defaults; chosen on validation scenes
    "FetchPush": ("--policy.updates", "4000"),
    "FetchSlide": ("--policy.updates", "4000"),
    "Soccer": ("--world_model.updates", "1800", "--policy.updates", "4000"),
}

PAGE = """# MuJoCo tasks

Success in %, [95 % interval over the scenes], (success of each seed). The interval says nothing about further trainings, which
differ by more. The numbers of updates of the decoupled rows were chosen for each task on validation scenes, in single development
runs that are not stored; those of Joint, End-to-End, ACT and Diffusion Policy are the recipes' defaults. On PlateSlide, plate and hand always
start in the same places: the goal, which policies are given, determines what to do, so that its column says nothing about
perception. Derived dynamics (of the hand, tracked, hand and color) are explained in
[dynmap_rl/envs/mujoco/README.md](../../../dynmap_rl/envs/mujoco/README.md#tasks). Tasks, cameras and experts are described in
[dynmap_rl/envs/mujoco/README.md](../../../dynmap_rl/envs/mujoco/README.md). Written by
`python recipes/paper/benchmarks3d.py --write` from the files in this folder.

{table}

Differences of the means, with 95 % intervals over trainings (Welch's t) where both sides have several. Intervals are not
corrected for the number of comparisons. ACT and Diffusion Policy are smaller than LeRobot's defaults, their settings are not
tuned, and they also read the hand's position:

{gaps}

Runs by commit: {commits}. A run that was resumed names the commit at its end.{devices}

## What fails

An object that is lost has fallen off the table, and one that is hardly moved stays within 10 mm of its start. In all
other failures the cause is where the object is in the last frame, as seen from its start
([definitions](../../../dynmap_rl/evaluation/failures.py)).

{failures}

Mean distance of the object's predicted and true positions in these episodes, one step ahead: {localization}. Which other entries
of the dynamics are learned: [dynmap_rl/envs/mujoco/README.md](../../../dynmap_rl/envs/mujoco/README.md#dynamics).

## Episodes

Eight episodes of the first seed, failures first; in brackets how they end, from left to right and from above.

{animations}

## Commands

`python recipes/paper/benchmarks3d.py --only NAME` also records and derives the dataset of a run.

```bash
{commands}
```
"""


def list_benchmarks(episodes: int = 500) -> dict[tuple[str, str, int], Run]:
    """Return the runs by task, method and seed; each trains from the start and evaluates on ``episodes`` scenes."""
    runs = {}
    for task in TASKS:
        for method, (recipe, options) in METHODS.items():
            if method in DERIVED and derived_columns(task, method) is None:
                continue
            for seed in SEEDS:
                name = f"mujoco:{task}{FRAMES.get(method, '')}"
                arguments = ["--task", name, *options, "--seeds", str(seed)]
                if recipe == "decoupled":
                    arguments += ["--world_model.seed", str(seed), *UPDATES.get(task, ())]
                arguments += ["--dataset", str(derived_dataset(task, method))] if method in DERIVED else []
                arguments += ["--eval.episodes", str(episodes), "--eval.paper_episodes", "0"]
                cell = name, recipe, "recurrent", method
                run = name_run(task, method, seed)
                runs[task, method, seed] = Run(run, recipe, cell, tuple(arguments), table="mujoco")
    return runs


def name_run(task: str, method: str, seed: int) -> str:
    """Return the name of a run and of its result."""
    words = method.lower().translate(str.maketrans("-+ ", "___", "[],"))
    return f"{task.lower()}_{words}_seed_{seed}"


def derived_dataset(task: str, method: str) -> Path:
    """Return the folder of the demonstrations of a task with derived dynamics."""
    name = re.sub("(?<=[a-z])(?=[A-Z])", "_", task).lower()
    return Path("datasets") / f"{name}_{DERIVED[method][0]}"


def derived_columns(task: str, method: str) -> dict | None:
    """Return the arguments that derive a row's columns, or None if the task's object has no colour to find it by."""
    name, columns = DERIVED[method]
    if name != "color":
        return columns
    return columns | COLORS[task] if task in COLORS else None


def derive_dataset(task: str, recording: Path, method: str, folder: Path) -> None:
    """Derive a dataset from a recording if it is missing."""
    if not folder.exists():
        add_dynamics(recording, folder, **derived_columns(task, method), replace=True)


def read_benchmarks(results: Path) -> dict[tuple[str, str], list[dict]]:
    """Read the results by task and method, each a list of the seeds that are there."""
    cells = dict.fromkeys((task, method) for task, method, _ in list_benchmarks())
    found = {
        cell: read_on_same_scenes(results / f"{name_run(*cell, seed)}.json" for seed in SEEDS)
        for cell in cells
    }
    return {cell: seeds for cell, seeds in found.items() if seeds}


def read_experts(results: Path) -> dict[str, dict]:
    """Read the results of the experts, ``expert_TASK.json`` of ``recipes/evaluate.py --task mujoco:TASK``, by task."""
    paths = {task: results / f"expert_{task.lower()}.json" for task in TASKS}
    return {task: read_json(path) for task, path in paths.items() if path.exists()}


def benchmark_rows(results: Path) -> list[dict]:
    """Return a row for each task and method: SR, PE and DR over the seeds, intervals, and failures by cause.

    Returns:
        Dicts with ``task``, ``method``, ``seeds``, ``episodes``, ``SR``, ``SR_interval``, ``DR`` (%),
        ``PE`` (mm), ``localization`` (mm; None if the world model does not predict the object's position), ``rates`` (SR of
        each seed), ``causes`` (number of failed episodes by cause), ``commands``, ``commits`` and
        ``devices``. Intervals count with start states that the seeds share.

    Raises:
        ValueError: the seeds of a row were evaluated on different scenes.
    """
    table = []
    for (task, method), cells in read_benchmarks(results).items():
        rows = [part for cell in cells for part in result_rows(cell)]
        summary = summarize([row for part in rows for row in part])
        errors = [] if method in DERIVED else _localization(cells)  # of other entries, or in pixels
        table.append(
            {
                "task": task,
                "method": method,
                "seeds": len(rows),
                **{name: summary[name] for name in ("episodes", "SR", "DR", "PE")},
                "SR_interval": shared_interval(rows),
                "localization": fmean(errors) if errors else None,
                "rates": [summarize(part)["SR"] for part in rows],
                "causes": summary.get("causes", {}),
                "commands": [cell["command"] for cell in cells],
                "commits": [str(cell.get("commit")) for cell in cells],
                "devices": count_devices(cells),
            }
        )
    return table


def _localization(cells: list[dict]) -> list[float]:
    summaries = [cell.get("test_protocol", {}) for cell in cells]
    return [summary["localization"] for summary in summaries if "localization" in summary]


def benchmark_table(rows: list[dict], experts: dict[str, dict] | None = None) -> str:
    """Return the table in Markdown: a line for each method, a column for each task; empty where there is no result.

    Args:
        rows: see :func:`benchmark_rows`.
        experts: see :func:`read_experts`.
    """
    cells, lines = {(row["task"], row["method"]): row for row in rows}, []
    if experts:
        rates = {task: (r["rates"]["success"], *r["intervals"]["success"]) for task, r in experts.items()}
        texts = {task: "{:.1f} [{:.1f}, {:.1f}]".format(*numbers) for task, numbers in rates.items()}
        lines.append(["expert, from the state", *(texts.get(task, "") for task in TASKS)])
    for method in METHODS:
        line = [method]
        for task in TASKS:
            row = cells.get((task, method))
            line.append(_describe(row) if row else "")
        lines.append(line)
    return join_table(["success %", *TASKS], lines)


def gap_table(rows: list[dict]) -> str:
    """Return a table of the differences of methods in SR, in points, with intervals over trainings."""
    rates, lines = {(row["task"], row["method"]): row["rates"] for row in rows}, []
    for method, other in GAPS:
        pairs = {task: (rates.get((task, method)), rates.get((task, other))) for task in TASKS}
        hard = [pairs[task] for task in TASKS if task != "PlateSlide"]
        mean = mean_gap(hard) if all(all(pair) for pair in hard) else None
        text = "{:+.1f} [{:+.1f}, {:+.1f}]".format(*mean) if mean else ""
        lines.append([f"{method} - {other}", *(gap_text(*pair) for pair in pairs.values()), text])
    return join_table(["points of SR", *TASKS, "mean without PlateSlide"], lines)


def benchmark_page(rows: list[dict], folder: Path) -> str:
    """Return the page of the results in Markdown, with the animations that are in the folder."""
    titles = [f"{row['task']}: {row['method']}" for row in rows]
    runs = [name_run(row["task"], row["method"], SEEDS[0]) for row in rows]
    animations = [
        f"{title} ({_outcomes(read_json(folder / f'{run}.json'))}):\n\n![Episodes, failures first]({run}.gif)"
        for title, run in zip(titles, runs, strict=True)
        if (folder / f"{run}.gif").exists()
    ]
    distances = [
        f"{title} {row['localization']:.0f} mm"
        for title, row in zip(titles, rows, strict=True)
        if row["localization"] is not None
    ]
    experts = read_experts(folder)
    commands = [result["command"] for result in experts.values()]
    commands += [command for row in rows for command in row["commands"]]
    return PAGE.format(
        table=benchmark_table(rows, experts),
        commits=commits_text(Counter(commit for row in rows for commit in row["commits"])),
        devices=devices_text(sum((Counter(row["devices"]) for row in rows), Counter())),
        gaps=gap_table(rows),
        failures=cause_table(
            (t, row["episodes"], row["causes"]) for t, row in zip(titles, rows, strict=True)
        ),
        localization=", ".join(distances) or "not measured",
        animations="\n\n".join(animations),
        commands="\n".join(commands),
    )


def _outcomes(result: dict) -> str:
    """Return what happens in the episodes of the animation, from left to right and from above."""
    rows = choose_episodes(result["results"][0]["test"]["rows"])
    causes = [row.get("cause", "fails") for row in rows if not row["success"]]
    return ", ".join([*causes, f"{len(rows) - len(causes)} successes"])


def _describe(row: dict) -> str:
    low, high = row["SR_interval"]
    text = f"**{row['SR']:.1f}** [{low:.1f}, {high:.1f}]"
    text += f" ({', '.join(f'{rate:.1f}' for rate in row['rates'])})" if row["seeds"] > 1 else ""
    text += f", off the table {row['DR']:.1f}" if row["DR"] else ""
    return text + (f" ({row['seeds']} of {len(SEEDS)} seeds)" if row["seeds"] < len(SEEDS) else "")
