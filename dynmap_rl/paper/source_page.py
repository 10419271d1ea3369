"""Page of the grid of sources: tables, figures, rank correlations and commands."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.utils.files import read_json, write_bytes

from .results import count_devices
from .source_figures import plot_data, plot_measures, plot_sources
from .source_results import (
    MEASURES,
    data_table,
    find_unmeasured,
    gap_table,
    rank_correlations,
    read_source,
    source_table,
)
from .sources import POLICIES, SOURCES
from .tables import commits_text, devices_text, join_table, p_text

REPEATED = (
    "The world models of these runs were trained again between their recurrent and their feed-forward policies, and only the "
    "training that was measured is in the figures of measures: {}."
)
SOURCES_FIGURE = (
    "Lines in the figure are the 95 % intervals over the test scenes, and ticks the rates of the world models. Sources whose lines do "
    "not overlap may still not differ over world models: see the table of differences."
)
DATA = (
    "Bands in the figure are the 95 % intervals over the test scenes, for the world models that there are: one, or as many as "
    "rates stand in brackets here and as small dots in the figure. Each policy of End-to-End has a world model of its own."
)
FORMS = {"glimpse": "the default encoder and decoder", "plain": "a plain CNN"}


def write_source_page(results: Path, tasks: list[str], architecture: str = "glimpse") -> list[Path]:
    """Write ``README.md`` and the figures into the folder of the results; return the files.

    Args:
        results: folder of the results.
        tasks: names of the tasks; those without a result are left out.
        architecture: form of the world models.
    """
    parts = [
        "# Sources of dynamics, and numbers of demonstrations",
        f"World models have {FORMS[architecture]}. The rows are explained in [recipes/README.md](../../README.md"
        "#sources-of-dynamics), the verdicts of `add_dynamics.py` on derived columns, before any training, in "
        "[dynmap_rl/data/README.md](../../../dynmap_rl/data/README.md#quality-of-derived-columns). SR in % with 95 % "
        "intervals over the test scenes, which do not cover differences between trainings; those of the differences from the simulator's dynamics are over world models. "
        "Share of the gain: (SR - SR of Only-RGB) / (SR with the simulator's dynamics - SR "
        "of Only-RGB). Policies of rows with 15 copies are also trained on the states of 15 augmented copies of every "
        "demonstration. Measures are both R^2 and the error after two seconds: means over the world models that were "
        f"measured ({_measured(results)}), as are the rates in the figures of measures and in rank correlations. Several "
        "sources are one recording with different noise, so that p is too small. A verdict names the checks that failed. Written by "
        "`recipes/paper/sources.py --write`.",
    ]
    written, repeated = [], find_unmeasured(results)
    for task in tasks:
        if not any(read_source(results, task, source, policy) for source in SOURCES for policy in POLICIES):
            continue
        parts += [f"## {task}", source_table(results, task), gap_table(results, task)]
        correlations = rank_correlations(results, task)
        rows = [
            [policy, MEASURES[measure][0], f"{row['rho']:.2f}", p_text(row["p"]), str(row["sources"])]
            for (policy, measure), row in correlations.items()
        ]
        parts.append(SOURCES_FIGURE)
        plots = {"sources": plot_sources}
        plots |= {"measures": partial(plot_measures, correlations=correlations)} if rows else {}
        for name, plot in plots.items():
            written.append(results / f"{get_task(task).name}_{name}.png")
            plot(results, task, written[-1])
            parts.append(f"![{name}]({written[-1].name})")
        if rows:
            parts.append(join_table(["policy", "measure", "rank correlation with SR", "p", "sources"], rows))
    written.append(results / "data.png")
    plot_data(results, "balance_reaching", written[-1])
    parts += [
        "## Number of demonstrations",
        DATA,
        data_table(results, "balance_reaching"),
        "![data](data.png)",
    ]
    parts += [REPEATED.format(", ".join(f"`{name}`" for name in repeated))] if repeated else []
    found = [read_json(path) for path in sorted(results.glob("*.json"))]
    commits = commits_text(Counter(result["commit"] for result in found))
    commands = sorted(
        {result["command"] for result in found}, key=lambda command: ("--pretrained" in command, command)
    )
    form = "" if architecture == "glimpse" else f" --architecture {architecture}"
    parts += [
        "## Commands",
        f"`python recipes/paper/sources.py{form} --tasks TASK --only SOURCE` also derives the dataset of a source. "
        f"Runs by commit: {commits}.{devices_text(count_devices(found))}",
        "\n".join(["```bash", *commands, "```"]),
    ]
    written.append(results / "README.md")
    write_bytes(written[-1], ("\n\n".join(parts) + "\n").encode())
    return written


def _measured(results: Path) -> str:
    trained = len([*results.glob("*_world_model_*_recurrent.json")])
    return f"{len([*results.glob('measures/*.json')])} of {trained} world models"
