"""Success against the delay of frames: conditions, and table and figure from their results."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.reporting.figures import plt, save_figure
from dynmap_rl.utils.files import read_json

from .results import ROWS
from .tables import join_table

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
    "past_actions": ("feed-forward with past actions", {}, False, True),
    "pushed": ("unannounced pushes", {}, True, False),
    "pushed_stale": ("unannounced pushes, stale frames", {}, True, True),
}


def frame_delay(condition: str, steps: int) -> FrameDelay | None:
    """Return how frames arrive under a condition; None where the condition is impossible with so short a delay."""
    try:
        return FrameDelay(steps, **CONDITIONS[condition][1])
    except ValueError:
        return None


def read_delays(folder: Path) -> list[dict]:
    """Read the results of ``recipes/paper/delays.py``, sorted by task, supervision, policy and condition."""
    results = [read_json(path) for path in sorted(folder.glob("*.json"))]
    rows, conditions = {row: index for index, row in enumerate(ROWS)}, list(CONDITIONS)

    def place(result: dict) -> tuple:
        row = rows.get(result["row"], len(rows))  # policies of LeRobot come last
        return result["task"], row, result["row"], result["policy"], conditions.index(result["condition"])

    return sorted(results, key=place)


def delay_table(results: list[dict]) -> str:
    """Return SR (%) with 95 % Wilson intervals as a table in Markdown: a line for each run and condition."""
    delays = sorted({int(steps) for result in results for steps in result["cells"]})
    header = ["task", "world model", "policy", "condition"]
    header += [f"{round(1000 * CONTROL_DT * steps)} ms" for steps in delays]
    lines = []
    for result in results:
        cells = [result["cells"].get(str(steps)) for steps in delays]
        values = [
            f"**{c['SR']:.1f}** [{c['SR_interval'][0]:.1f}, {c['SR_interval'][1]:.1f}]" if c else ""
            for c in cells
        ]
        text = CONDITIONS[result["condition"]][0]
        lines.append([result["task"], result["row"], result["policy"], text, *values])
    return join_table(header, lines)


def delay_page(results: list[dict]) -> str:
    """Return the page of the results: what was measured, the table, and the commands."""
    sizes = sorted({(result["split"], result["episodes"]) for result in results})
    scenes = ", ".join(f"{count} scenes of the split {split}" for split, count in sizes)
    commands = sorted({result["command"] for result in results})
    return "\n".join(
        [
            "# Success against the delay of the frames",
            "",
            f"SR in % with 95 % Wilson intervals, on {scenes}. Written by `recipes/paper/delays.py --write`.",
            "",
            delay_table(results),
            "",
            "```bash",
            *commands,
            "```",
            "",
        ]
    )


def plot_delays(results: list[dict], path: Path) -> None:
    """Draw SR against the delay, with intervals, and an axis of rates of its own for each panel.

    A task and policy type have a panel with a line for each supervision, rolled forward, and another on stale frames. A run
    that was measured under further conditions has a panel with a line for each condition.

    Args:
        results: see :func:`read_delays`.
        path: file to write.
    """
    panels = _group(results)
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    texts = [text for text, *_ in CONDITIONS.values()]
    shades = plt.get_cmap("tab20").colors
    colors = dict(zip(ROWS, shades[::2], strict=False)) | dict(
        zip(texts, (*shades[::2], *shades[1::2]), strict=False)
    )
    size = 5 * columns, 3.4 * rows
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, sharex=True, layout="constrained")
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    for axis, (title, lines) in zip(axes.flat, panels.items(), strict=False):
        for label, result in lines.items():
            _draw_line(axis, result, label, colors.get(label))
        axis.set_title(title, fontsize=8)
        axis.set_xlabel("delay of the frames [ms]", fontsize=8)
        axis.set_ylabel("success [%]", fontsize=8)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=7, labelbottom=True)
        axis.legend(fontsize=6)
    save_figure(figure, path)


def _group(results: list[dict]) -> dict[str, dict[str, dict]]:
    """Return the results of each panel by their labels: supervisions first, then conditions."""
    supervisions, conditions = {}, {}
    for result in results:
        task, row, policy, condition = (result[name] for name in ("task", "row", "policy", "condition"))
        conditions.setdefault(f"{task}, {policy}: {row}", {})[CONDITIONS[condition][0]] = result
        if condition in ("imagined", "stale"):
            panel = f"{task}, {policy}: {CONDITIONS[condition][0]}"
            supervisions.setdefault(panel, {})[row] = result
    further = {
        panel: lines
        for panel, lines in conditions.items()
        if any(result["condition"] not in ("imagined", "stale") for result in lines.values())
    }
    return dict(sorted(supervisions.items())) | further


def _draw_line(axis, result: dict, label: str, color: str) -> None:
    steps = sorted(map(int, result["cells"]))
    cells = [result["cells"][str(step)] for step in steps]
    time = [1000 * CONTROL_DT * step for step in steps]
    low, high = zip(*(cell["SR_interval"] for cell in cells), strict=True)
    rates = [cell["SR"] for cell in cells]
    errors = [
        [r - x for r, x in zip(rates, low, strict=True)],
        [x - r for r, x in zip(rates, high, strict=True)],
    ]
    style = "--" if CONDITIONS[result["condition"]][3] else "-"
    axis.errorbar(
        time, rates, errors, ls=style, color=color, lw=1.4, elinewidth=1, capsize=2, marker=".", label=label
    )
