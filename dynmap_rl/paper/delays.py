"""Success against the delay of frames: conditions, and table and figure from their results."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.reporting.figures import plt, save_figure
from dynmap_rl.utils.files import read_json

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
    order = list(CONDITIONS)
    return sorted(results, key=lambda r: (r["task"], r["row"], r["policy"], order.index(r["condition"])))


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
    """Draw SR against the delay, a panel for each run and a line with its interval for each condition.

    Args:
        results: see :func:`read_delays`.
        path: file to write.
    """
    panels: dict[tuple, list[dict]] = {}
    for result in results:
        panels.setdefault((result["task"], result["row"], result["policy"]), []).append(result)
    columns = min(len(panels), 4)
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(
        rows,
        columns,
        figsize=(4.2 * columns, 3 * rows + 1.2),
        squeeze=False,
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    shades = plt.get_cmap("tab20").colors
    colors = dict(zip(CONDITIONS, (*shades[::2], shades[1], (0, 0, 0)), strict=True))
    for axis in axes.flat[len(panels) :]:
        axis.remove()
    for axis, (name, lines) in zip(axes.flat, panels.items(), strict=False):
        for result in lines:
            _draw_line(axis, result, colors[result["condition"]])
        axis.set_title(", ".join(name), fontsize=8)
        axis.set_xlabel("delay of the frames [ms]", fontsize=8)
        axis.set_ylim(-3, 103)
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=7)
    for axis in axes[:, 0]:
        axis.set_ylabel("success [%]", fontsize=8)
    handles = {
        text: handle
        for axis in figure.axes
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(), handles, loc="outside lower center", ncols=min(columns + 1, 3), fontsize=7
    )
    save_figure(figure, path)


def _draw_line(axis, result: dict, color) -> None:
    steps = sorted(map(int, result["cells"]))
    cells = [result["cells"][str(step)] for step in steps]
    time = [1000 * CONTROL_DT * step for step in steps]
    low, high = zip(*(cell["SR_interval"] for cell in cells), strict=True)
    text, _, _, stale = CONDITIONS[result["condition"]]
    width = 3 if result["condition"] == "imagined" else 1.4  # others may lie on it
    style, rates = "--" if stale else "-", [cell["SR"] for cell in cells]
    axis.plot(time, rates, style, color=color, lw=width, marker=".", label=text)
    axis.fill_between(time, low, high, color=color, alpha=0.12, lw=0)
