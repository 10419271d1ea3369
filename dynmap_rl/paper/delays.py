"""Success against the delay of frames: conditions, and table and figure from their results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.reporting.figures import plt, save_figure
from dynmap_rl.utils.files import read_json

from .past_actions import LONGEST
from .results import ROWS, count_devices
from .tables import commits_text, devices_text, join_table

DELAYS = 0, 2, 4, 6, 10, 16, 24, 30  # control steps
CONDITIONS = {  # name: text, settings of the frames besides the delay, whether pushed, and whether stale
    "stale": ("stale frames", {}, False, True),
    "imagined": ("rolled forward", {}, False, False),
    "error_1": ("delay reported 1 step too long", {"error": 1}, False, False),
    "error_-1": ("delay reported 1 step too short", {"error": -1}, False, False),
    "error_3": ("delay reported 3 steps too long", {"error": 3}, False, False),
    "error_-3": ("delay reported 3 steps too short", {"error": -3}, False, False),
    "jitter": ("jitter of 2 steps", {"jitter": 2}, False, False),
    "lost_10": ("10 % of the frames lost", {"lost": 0.1}, False, False),
    "lost_30": ("30 % of the frames lost", {"lost": 0.3}, False, False),
    "past_actions": ("with past actions", {}, False, True),
    "pushed": ("unannounced pushes", {}, True, False),
    "pushed_stale": ("unannounced pushes, stale frames", {}, True, True),
}


def frame_delay(condition: str, steps: int) -> FrameDelay | None:
    """Return how frames arrive under a condition; None where the delay is too short or too long for it."""
    if condition == "past_actions" and steps > LONGEST:
        return None
    try:
        return FrameDelay(steps, **CONDITIONS[condition][1])
    except ValueError:
        return None


def read_delays(folder: Path) -> list[dict]:
    """Read the results of ``recipes/paper/delays.py``, sorted by task, supervision, policy, run and condition."""
    results = [read_json(path) for path in sorted(folder.glob("*.json"))]
    rows, conditions = {row: index for index, row in enumerate(ROWS)}, list(CONDITIONS)

    def place(result: dict) -> tuple:
        row = rows.get(result["row"], len(rows))  # policies of LeRobot come last
        names = result["row"], result["policy"], _run(result)
        return result["task"], row, *names, conditions.index(result["condition"])

    return sorted(results, key=place)


def list_delayed_runs(results: list[dict]) -> list[str]:
    """Return the runs of some results, each seed once, in their order; the table has their numbers, from 1."""
    return list(dict.fromkeys(map(_run, results)))


def _run(result: dict) -> str:
    return f"{result['run']}, seed {result['seed']}" if result.get("seed") else result["run"]


def name_row(folder: Path, world_model: WorldModel) -> str:
    """Return the row of a run: its supervision and, where it is not the default, training and architecture."""
    path = folder / "eval.json"
    source = read_json(path).get("world_model", {}) if path.exists() else {}
    row = row_name(world_model.supervision, training := source.get("training", "decoupled"))
    other = [training] if training == "joint" else []
    other += [world_model.architecture] if world_model.architecture != "glimpse" else []
    return ", ".join([row, *other])


def find_training(folder: Path) -> dict[str, str]:
    """Return command and commit of the training of a run; empty where it has no ``eval.json``."""
    path = folder / "eval.json"
    found = read_json(path) if path.exists() else {}
    return {name: found[name] for name in ("command", "commit") if name in found}


def delay_table(results: list[dict]) -> str:
    """Return SR (%) with 95 % Wilson intervals as a table in Markdown: a line for each run and condition."""
    cells_by_time = [
        {_milliseconds(result, steps): c for steps, c in result["cells"].items()} for result in results
    ]
    times = sorted(set().union(*cells_by_time))
    runs = list_delayed_runs(results)
    header = ["task", "world model", "policy", "run", "condition", *(f"{time} ms" for time in times)]
    lines = []
    for result, found in zip(results, cells_by_time, strict=True):
        cells = [found.get(time) for time in times]
        values = [
            f"**{c['SR']:.1f}** [{c['SR_interval'][0]:.1f}, {c['SR_interval'][1]:.1f}]" if c else ""
            for c in cells
        ]
        names = [result[name] for name in ("task", "row", "policy")]
        lines.append([*names, str(runs.index(_run(result)) + 1), condition_text(result), *values])
    return join_table(header, lines)


def delay_page(results: list[dict]) -> str:
    """Return the page of the results: what was measured, the table, and the commands."""
    sizes = sorted({(result["split"], result["episodes"]) for result in results})
    scenes = ", ".join(f"{count} scenes of the split {split}" for split, count in sizes)
    cells = [cell for result in results for cell in result["cells"].values()]
    commands = sorted({cell["command"] for cell in cells})
    commits = commits_text(Counter(str(cell.get("commit")) for cell in cells))
    trained = {_run(result): result["trained"].get("command") for result in results}
    runs = [
        f"{i}. `{run}`: "
        + (
            f"`{trained[run]}`"
            if trained[run]
            else "ships with the package, but for a policy with past actions"
        )
        for i, run in enumerate(list_delayed_runs(results), 1)
    ]
    return "\n".join(
        [
            "# Success against the delay of the frames",
            "",
            f"SR in % with 95 % Wilson intervals, on {scenes}. Written by `recipes/paper/delays.py --write`.",
            "",
            "Frames are late, and the goal is not. With `rolled forward`, the world model predicts the steps from the newest",
            "frame to the present; with `stale frames`, the policy treats the newest frame as the present one. The policy with",
            "past actions reads the newest frame, the action before it, and the actions sent since. It is trained with a random",
            "delay of 0 to 30 steps in every episode. Policies of LeRobot also read the commanded pose of the cart, which is not",
            "late, so that their rows and ours are no comparison on the same inputs. ACT of `recipes/baseline.py` executes",
            "ten actions of chunks of 20: beyond 500 ms, chunks from the present step end too early, and their last action is",
            "repeated. Every row is one world model and one policy. Unannounced pushes take the place of some actions, and the policy is not told;",
            "that it then succeeds more often with late frames than with present ones is not explained.",
            "",
            delay_table(results),
            "",
            "Runs, with the commands that trained them:",
            "",
            *runs,
            "",
            f"Entries of the table by commit: {commits}.{devices_text(count_devices(cells))} Commands of the measurements:",
            "",
            "```bash",
            *commands,
            "```",
            "",
        ]
    )


def plot_delays(results: list[dict], path: Path) -> None:
    """Draw success with its intervals against the delay: a line for each result with more than four delays.

    Args:
        results: see :func:`read_delays`.
        path: file to write.
    """
    lines = [result for result in results if len(result["cells"]) > 4]
    figure, axis = plt.subplots(figsize=(7.5, 3), layout="constrained")
    if lines:
        _draw_lines(axis, lines)
    axis.grid(alpha=0.3)
    save_figure(figure, path)


def plot_conditions(results: list[dict], path: Path) -> None:
    """Draw success with its intervals at a few delays as dots.

    A panel has a line for each supervision and policy of a task, on stale frames and rolled forward, or for each
    condition. Of several runs of a supervision, the one with the most conditions and delays is shown. A panel with less
    than two lines is left out.

    Args:
        results: see :func:`read_delays`.
        path: file to write.
    """
    panels = [(title, dots) for title, dots in _dots(results).items() if len(dots) > 1]
    columns = min(len(panels), 2) or 1
    rows = -(-len(panels) // columns) or 1
    figure, axes = plt.subplots(
        rows, columns, figsize=(5.4 * columns, 3.6 * rows), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    for axis, (title, dots) in zip(axes.flat, panels, strict=False):
        _draw_dots(axis, title, dots)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
    save_figure(figure, path)


def condition_text(result: dict) -> str:
    """Return what was done about the delay; a policy of LeRobot bridges it by its chunks."""
    chunks = {"stale": "chunks from their first action", "imagined": "chunks from the present step"}
    if result["policy"] == "LeRobot" and result["condition"] in chunks:
        return chunks[result["condition"]]
    return CONDITIONS[result["condition"]][0]


def _text(result: dict) -> str:
    row = result["row"].upper() if result["policy"] == "LeRobot" else f"{result['row']}, {result['policy']}"
    task = "" if result["task"] == "balance_reaching" else f"{result['task']}, "
    return f"{task}{row}: {condition_text(result)}"


def _milliseconds(result: dict, steps: int | str) -> int:
    return round(1000 * get_task(result["task"]).layout.dt * int(steps))


def _dots(results: list[dict]) -> dict[str, dict[str, dict[str, dict]]]:
    """Return the cells of each panel of dots, by their line and their marker."""
    panels = {}
    shown = [r for r in results if r["policy"] != "LeRobot" and r["condition"] != "past_actions"]
    for result in _choose_runs(shown):
        task, row, policy, condition = (result[name] for name in ("task", "row", "policy", "condition"))
        for steps, cell in sorted(result["cells"].items(), key=lambda item: int(item[0])):
            time, text = _milliseconds(result, steps), condition_text(result)
            if condition in ("stale", "imagined"):
                panel = panels.setdefault(task, {}).setdefault(f"{row}, {policy}", {})
                panel[f"{text}, {time} ms" if time else "no delay"] = cell
            else:
                panel = panels.setdefault(f"{task}, {row}, {policy}: conditions", {})
                panel.setdefault(text, {})[f"{time} ms"] = cell
    return {
        title: panel if title.endswith("conditions") else _drop_rare(panel) for title, panel in panels.items()
    }


def _choose_runs(results: list[dict]) -> list[dict]:
    """Return the results of one run for each supervision and policy of a task, that with the most results and cells."""
    rows = {}
    for result in results:
        runs = rows.setdefault((result["task"], result["row"], result["policy"]), {})
        runs.setdefault(_run(result), []).append(result)
    return [
        result
        for runs in rows.values()
        for result in max(runs.values(), key=lambda found: (len(found), sum(len(r["cells"]) for r in found)))
    ]


def _drop_rare(panel: dict[str, dict[str, dict]]) -> dict[str, dict[str, dict]]:
    """Return the panel without the delays of a single line, which nothing is compared with."""
    count = Counter(name for cells in panel.values() for name in cells)
    count["no delay"] += 1  # is what all delays are compared with
    kept = {line: {name: c for name, c in cells.items() if count[name] > 1} for line, cells in panel.items()}
    return {line: cells for line, cells in kept.items() if cells}


def _draw_lines(axis, lines: list[dict]) -> None:
    for result in lines:
        steps = sorted(map(int, result["cells"]))
        cells = [result["cells"][str(step)] for step in steps]
        rates, errors = [cell["SR"] for cell in cells], _errors(cells)
        style = {"ls": "--" if CONDITIONS[result["condition"]][3] else "-", "lw": 1.4, "elinewidth": 1}
        time = [_milliseconds(result, step) for step in steps]
        axis.errorbar(time, rates, errors, capsize=2, marker=".", label=_text(result), **style)
    axis.set(xlabel="delay of the frames [ms]", ylabel="success [%]", ylim=(-3, 103))
    axis.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.02, 0.5))


def _draw_dots(axis, title: str, dots: dict[str, dict[str, dict]]) -> None:
    names, markers = list(dots), sorted({name for cells in dots.values() for name in cells}, key=_order)
    for shape, (index, label) in zip(cycle("os^Dv<>P"), enumerate(markers), strict=False):
        shift = 0.15 * (index - (len(markers) - 1) / 2)
        found = [(place + shift, cells[label]) for place, cells in enumerate(dots.values()) if label in cells]
        places, cells = zip(*found, strict=True)
        rates, style = [cell["SR"] for cell in cells], {"ls": "", "marker": shape, "ms": 4, "capsize": 2}
        color = {"no delay": "C7", "stale": "C1"}.get(label.split(" frames")[0], "C0")
        axis.errorbar(rates, places, xerr=_errors(cells), label=label, color=color, **style)
    axis.set_yticks(range(len(names)), names)
    axis.set(xlim=(-2, 102), ylim=(len(names) - 0.5, -0.5))
    axis.set_title(title, fontsize=9)
    axis.set_xlabel("success [%]", fontsize=8)
    axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)


def _order(label: str) -> tuple[bool, bool, int]:
    """Return the place of a marker: without delay, on stale frames, rolled forward; the shorter delay first."""
    return label != "no delay", "stale" not in label, int("".join(filter(str.isdigit, label)) or 0)


def _errors(cells: Sequence[dict]) -> list[list[float]]:
    """Return how far the intervals reach below and above the rates."""
    rates, (low, high) = [cell["SR"] for cell in cells], zip(*(c["SR_interval"] for c in cells), strict=True)
    below = [rate - end for rate, end in zip(rates, low, strict=True)]
    return [below, [end - rate for rate, end in zip(rates, high, strict=True)]]
