"""Tables of measurements beside the cells: what world models see, and everything else."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.utils.files import read_json

from .published import METRICS
from .tables import join_table

UNITS = {"DR": "%", "PE": "mm"}
PERCEPTION = "object_error", "chroma_explained", "goal_explained", "background_error"
HEAD = ["", "on", "colour error", "chroma", "goal", "background", "cart", "open loop: cart, block"]


def markdown_perception(probe: dict) -> str:
    """Return a table of what the world models of a ``probe.json`` see (see ``recipes/probe.py``)."""
    lines = []
    for name, places in probe["perception"].items():
        for where, found in places.items():
            last = {
                key: values[-1] for key, values in probe["open_loop"].get(name, {}).get("model", {}).items()
            }
            held_out = where == "held-out demonstrations" and last
            lines.append([
                name, where, *(f"{found[key]:.2f}" for key in PERCEPTION), f"{1000 * found['cart_error']:.1f} mm",
                f"{last['cart_mm']:.1f} mm, {last['block_mm']:.1f} mm" if held_out else "",
            ])  # fmt: skip
    return join_table(HEAD, lines)


def markdown_ablations(found: dict) -> str:
    """Return a table of the measurements of the ablations' world models.

    Args:
        found: ``late``, the evaluation of each row's policy on late frames, and ``world_models``, for each row with a
            world model of its own the entries of ``probe.json`` (see ``recipes/probe.py``): ``perception`` on held-out
            demonstrations, and ``open_loop``.
    """
    lines = []
    for row, late in found["late"].items():
        low, high = late["SR_interval"]
        line = [row, f"{late['DR']:.1f}", f"**{late['SR']:.1f}** [{low:.1f}, {high:.1f}]"]
        if probe := found["world_models"].get(row):
            line += [f"{probe[key]:.2f}" for key in PERCEPTION]
            line += [f"{1000 * probe['cart_error']:.1f} mm"]
            line += [f"{probe['cart_mm']:.0f} mm, {probe['block_mm']:.0f} mm"]
        lines.append(line + [""] * (len(HEAD) - len(line) + 1))
    return join_table(["", "DR, late frames", "SR, late frames", *HEAD[2:]], lines)


def markdown_measurements(folder: Path, contents: dict[str, dict]) -> str:
    """Return a table of other measurements.

    Args:
        folder: folder of their JSON files.
        contents: what each shows (``what``) and its ``command``, by the name of the file.
    """
    rows = []
    for name, entry in contents.items():
        result = read_json(folder / name)
        command = result.get("command", entry["command"])
        rows.append([f"[{name}](measurements/{name})", entry["what"], _headline(result), f"`{command}`"])
    return join_table(["file", "what", "result", "command"], rows)


def _headline(result: dict) -> str:
    """Return the success rate of a measurement that has one, with the other metrics of the task."""
    if summary := result.get("summary") or result.get("test_protocol"):
        low, high = summary["SR_interval"]
        names = [name for name in METRICS.get(result["task"], ()) if name in UNITS]
        others = [f"{name} {summary[name]:.1f} {UNITS[name]}" for name in names]
        return ", ".join([f"SR {summary['SR']:.1f} % [{low:.1f}, {high:.1f}]", *others])
    if rates := result.get("rates"):
        low, high = result["intervals"]["success"]
        return f"success {rates['success']:.1f} % [{low:.1f}, {high:.1f}]"
    return f"success {result['pc_success']:.1f} % of {result['n_episodes']}" if "pc_success" in result else ""
