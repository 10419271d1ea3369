"""Figures of the grid of sources."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.reporting.figures import plt, save_figure

from .source_results import MEASURES, measured_points, read_source
from .sources import DATA_ROWS, POLICIES, SIZES, SOURCES

KINDS = {  # of sources, in the figure of measures: beginnings of their names
    "simulator, with or without RGB loss": ("simulator", "informed"),
    "none (Only-RGB)": ("none",),
    "central": ("central",),
    "savgol": ("savgol",),
    "frames": ("centroid", "tracks", "flow"),
    "5 to 50 % of the episodes": ("labelled",),
    "commanded cart pose, with or without tracks": ("command",),
}


def plot_sources(results: Path, task: str, path: Path) -> None:
    """Draw SR with its interval against the source, for both policies."""
    names = [s for s in SOURCES if any(read_source(results, task, s, p) for p in POLICIES)]
    figure, axis = plt.subplots(figsize=(7, 0.3 * len(names) + 1), layout="constrained")
    for shift, policy in zip((-0.12, 0.12), POLICIES, strict=True):
        for row, name in enumerate(names):
            if cell := read_source(results, task, name, policy):
                color = "tab:blue" if policy == "recurrent" else "tab:orange"
                axis.plot(cell["interval"], [row + shift] * 2, color=color, lw=1.5)
                label = policy if name == names[0] else None
                axis.plot(cell["SR"], row + shift, "o", color=color, ms=4, label=label)
                axis.plot(
                    cell["world_models"], [row + shift] * len(cell["world_models"]), "|", color="k", ms=5
                )
    axis.set_yticks(range(len(names)), [SOURCES[name].text for name in names], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("success [%]", fontsize=8)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=7)
    save_figure(figure, path)


def plot_data(results: Path, task: str, path: Path) -> None:
    """Draw SR with its interval against the number of demonstrations."""
    figure, axis = plt.subplots(figsize=(5.5, 3.5), layout="constrained")
    for name, text in DATA_ROWS.items():
        cells = {size: read_source(results, task, name, "recurrent", size) for size in SIZES}
        cells = {size: cell for size, cell in cells.items() if cell}
        if cells:
            [line] = axis.plot(list(cells), [cell["SR"] for cell in cells.values()], marker=".", label=text)
            low, high = zip(*(cell["interval"] for cell in cells.values()), strict=True)
            axis.fill_between(list(cells), low, high, color=line.get_color(), alpha=0.15, lw=0)
            for size, cell in cells.items():
                axis.plot([size], [cell["world_models"]], ".", ms=3, color=line.get_color())
    axis.set_xscale("log")
    axis.set_xticks(SIZES, map(str, SIZES))
    axis.minorticks_off()
    axis.set(xlabel="demonstrations", ylabel="success [%]", ylim=(-3, 103))
    axis.grid(alpha=0.3)
    if axis.lines:
        axis.legend(fontsize=8)
    save_figure(figure, path)


def plot_measures(results: Path, task: str, path: Path, correlations: dict) -> None:
    """Draw SR against each cheap measure, a colour for each kind of source, with :func:`rank_correlations`."""
    points = {policy: measured_points(results, task, policy) for policy in POLICIES}
    figure, axes = plt.subplots(1, len(MEASURES), figsize=(11, 4.6), sharey=True, layout="constrained")
    for axis, (measure, (text, _)) in zip(axes, MEASURES.items(), strict=True):
        title = []
        for marker, (policy, (names, rates, measures)) in zip("os", points.items(), strict=True):
            for name, y, x in zip(names, rates, measures[measure], strict=True):
                kind = next(kind for kind, names in KINDS.items() if name.startswith(names))
                named = any(line.get_label() == kind for line in axis.lines)
                color = f"C{list(KINDS).index(kind)}"
                axis.plot(x, y, marker, ms=6, color=color, alpha=0.8, label=None if named else kind)
            if found := correlations.get((policy, measure)):
                shape = {"o": "circles", "s": "squares"}[marker]
                title.append(f"{policy} ({shape}): rank correlation {found['rho']:.2f}")
        axis.set_title("\n".join(title), fontsize=8)
        axis.set_xlabel(text, fontsize=8)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("success [%]", fontsize=8)
    if axes[-1].lines:
        handles, labels = axes[-1].get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=4)
    save_figure(figure, path)
