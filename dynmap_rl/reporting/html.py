"""``report.html``: a run folder as one self-contained page."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path

from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.utils.files import read_json, write_bytes
from dynmap_rl.utils.settings import flatten

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60em; margin: 2em auto; padding: 0 1em; color: #222 }
img, svg { max-width: 100%; height: auto } pre { background: #f5f5f5; padding: .8em; overflow-x: auto }
table { border-collapse: collapse } td, th { padding: .15em .8em; border-bottom: 1px solid #ddd; text-align: left }
"""
TYPES = {".png": "image/png", ".gif": "image/gif"}
PICTURES = {  # in this order
    "rollouts.gif": "Rollouts in closed loop, failures first",
    "figures/reconstruction.png": "Held-out frames, and their predictions from the frame before",
    "figures/dynamics.png": "Dynamics of a body along a held-out episode, true and predicted",
    "open_loop.png": "Error of open-loop predictions against the time without frames",
    "probes.png": "R^2 of linear maps from the states to the dynamics",
    "perception.png": "Held-out demonstrations, and what each world model predicted from the frame before",
    "tracks.png": "The objects that were tracked, in the episode of the worst check",
    "episodes.gif": "Some of the episodes",
    "dynamics.png": "The dynamics of the first episode",
}


def write_html(
    folder: Path,
    title: str,
    row: str,
    command: str = "",
    settings: dict | None = None,
    pictures: dict[str, str] = PICTURES,
) -> Path:
    """Write ``report.html``: result, animations and figures, curves, settings and command on one page.

    Args:
        folder: folder with any of ``metrics.jsonl``, ``seed_N/metrics.jsonl`` and the pictures.
        title: title of the page.
        row: the result, as text.
        command: command that made the result.
        settings: settings, possibly nested; by default those of ``config.json`` in the folder.
        pictures: captions of files in the folder; missing files are left out.

    Returns:
        The path of the page.
    """
    parts = [f"<h1>{html.escape(title)}</h1>", f"<pre>{html.escape(row.strip())}</pre>"]
    for name, caption in pictures.items():
        if (folder / name).exists():
            data = base64.b64encode((folder / name).read_bytes()).decode()
            parts += [
                f"<h2>{html.escape(caption)}</h2>",
                f'<img alt="{html.escape(caption)}" src="data:{TYPES[Path(name).suffix]};base64,{data}">',
            ]
    curves = {path.name: read_metrics(path) for path in [folder, *sorted(folder.glob("seed_*"))]}
    if any(curves.values()):
        parts += ["<h2>Training</h2>", draw_curves({name: rows for name, rows in curves.items() if rows})]
    settings = read_json(folder / "config.json") if settings is None else settings
    cells = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(str(value))}</td></tr>"
        for name, value in flatten(settings).items()
    )
    parts += ["<h2>Settings</h2>", f"<table>{cells}</table>"]
    parts += [f"<pre>{html.escape(command)}</pre>"] if command else []
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )
    write_bytes(folder / "report.html", page.encode())
    return folder / "report.html"


def draw_curves(curves: dict[str, list[dict]], columns: int = 3) -> str:
    """Return all metrics over the steps as one SVG.

    Args:
        curves: rows of ``metrics.jsonl`` by label; every metric gets a panel, and every label a line in it.
        columns: panels in a row.
    """
    from .figures import plt

    names = list(
        dict.fromkeys(name for rows in curves.values() for row in rows for name in row if name != "step")
    )
    figure, axes = plt.subplots(
        -(-len(names) // columns),
        columns,
        figsize=(11, 2 * -(-len(names) // columns)),
        layout="constrained",
        squeeze=False,
    )
    for axis in axes.flat[len(names) :]:
        axis.axis("off")
    for axis, name in zip(axes.flat, names, strict=False):
        axis.set_title(name, fontsize=9)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.3)
        for label, rows in curves.items():
            points = [(row["step"], row[name]) for row in rows if isinstance(row.get(name), int | float)]
            if points:
                axis.plot(*zip(*points, strict=True), lw=1.2, label=label)
        if len(axis.lines) > 1:
            axis.legend(fontsize=6)
        values = [value for line in axis.lines for value in line.get_ydata()]
        if name.startswith(("loss", "error", "held_out")) and min(values, default=0) > 0:
            axis.set_yscale("log")
    buffer = io.StringIO()
    with plt.rc_context({"svg.hashsalt": "report"}):  # the same run gives the same page
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
