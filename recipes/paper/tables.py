"""Run the grid of the paper's Tables I, II and III and of two more run by run, and print the tables.

    python recipes/paper/tables.py --dry_run                  # runs, those that are complete, remaining time
    python recipes/paper/tables.py --results runs/results     # a grid of your own
    python recipes/paper/tables.py --table II,III             # runs of some tables
    python recipes/paper/tables.py --only balance_reaching_decoupled_position --workers 2
    python recipes/paper/tables.py --launcher ray             # on a Ray cluster (uv pip install -e '.[ray]')
    python recipes/paper/tables.py --print markdown           # tables from the results alone; or json, findings
    python recipes/paper/tables.py --write                    # recipes/results/README.md from the results alone

A cell of a table has a run of another recipe for each of three world models, or one run of joint or end-to-end training
with three seeds. The result of a run is a JSON file in the folder of the results; runs with a result are skipped. World
models are trained once and reused. The same command resumes a stopped grid. The page report.html in the folder of the
runs shows the tables so far.
"""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.paper.cells import TABLES, UNDISTURBED, Run, list_runs
from dynmap_rl.paper.launch import execute, has_run, is_done, launch, print_runs
from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.cluster import LAUNCHERS, check_launcher
from dynmap_rl.utils.settings import check_at_least

RECIPES = Path(__file__).parents[1]
RESULTS = RECIPES / "results"


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Folder of the results; by default those of the repository.
    results: Path = RESULTS / "cells"
    # Folder of the runs.
    runs: Path = Path("runs/tables")
    # Tables whose runs are chosen: any of I,II,III,extra,ablations.
    table: str = ",".join(TABLES)
    # Run to choose: its name, or a part of several names.
    only: str = ""
    # Runs at a time on this machine; each takes two cores if it is alone, otherwise one.
    workers: int = 1
    # local, or ray: the cluster of RAY_ADDRESS, or one on this machine. All machines must share this folder.
    launcher: str = "local"
    # CPUs of a run, with --launcher ray.
    cpus: float = 2
    # GPUs of a run, with --launcher ray.
    gpus: float = 0
    # Folder with a settings file RECIPE.yaml for any of the recipes, passed to their runs as --config_path.
    presets: Path | None = None
    # List the runs and stop.
    dry_run: bool = False
    # Print the tables as markdown or json, or the findings (the paper's claims as comparisons), and stop.
    print: str | None = None
    # Write recipes/results/README.md and the table in README.md, and stop.
    write: bool = False

    def __post_init__(self):
        check_at_least(self, 1, "workers", "cpus")
        if self.launcher not in LAUNCHERS:
            raise ValueError(f"--launcher must be {' or '.join(LAUNCHERS)}, got {self.launcher!r}")
        if self.print not in (None, "markdown", "json", "findings"):
            raise ValueError(f"--print must be markdown, json or findings, got {self.print!r}")
        if not set(self.table.split(",")) <= set(TABLES):
            raise ValueError(f"--table must be any of {','.join(TABLES)}, got {self.table!r}")
        if self.presets and not self.presets.is_dir():
            raise ValueError(f"--presets must be a folder, got {self.presets}")


def main(config: Config) -> None:
    """Execute the runs without a result, or print or write the tables."""
    if config.print:
        return print_tables(config.results, config.print)
    if config.write:
        return write_tables(config)
    ignored = {"local": ("cpus", "gpus"), "ray": ("workers",)}[config.launcher]
    refuse(config, Config(), ignored, f"--launcher {config.launcher}")
    chosen, todo = choose_runs(config)
    if config.dry_run:
        return print_runs([run for run in list_runs() if run in chosen or run in todo], todo)
    if not todo:
        print(
            f"nothing to do: {len(chosen)} runs are in {config.results}; choose another --results and --runs for a new grid"
        )
        return write_page(config)
    check_launcher(config.launcher)  # recording takes minutes
    record_datasets(todo)
    cores = config.cpus if config.launcher == "ray" else 2 if config.workers == 1 else 1
    start = partial(
        execute, recipes=RECIPES, results=config.results, runs=config.runs, threads=int(cores),
        presets=config.presets, root=Path.cwd(),
    )  # fmt: skip
    failed = launch(todo, start, config.launcher, workers=config.workers, cpus=config.cpus, gpus=config.gpus)
    write_page(config)
    if failed:
        raise ValueError("; ".join(failed))
    return None


def choose_runs(config: Config) -> tuple[list[Run], list[Run]]:
    """Return the chosen runs, and those to execute in order: without a result, or with a world model that is missing."""
    runs = list_runs()
    candidates = [run for run in runs if run.table in config.table.split(",")]
    chosen = [run for run in candidates if run.name == config.only]
    chosen = chosen or [run for run in candidates if config.only in run.name]
    if not chosen:
        raise ValueError(
            f"--only must be a part of a run's name, got {config.only!r}; --dry_run lists the names"
        )
    todo = {run.name: run.needed_run for run in chosen if not is_done(run.name, config.results)}
    needed = {source for source in todo.values() if source and not has_run(source, config.runs)}
    return chosen, [run for run in runs if run.name in todo or run.name in needed]


def record_datasets(runs: list[Run]) -> None:
    """Record the datasets that are missing: runs must not record at the same time."""
    from dynmap_rl.data.recording.record import record_dataset
    from dynmap_rl.training.dataset import find_or_record

    for task in {run.task for run in runs if not run.dataset}:
        find_or_record(task)
    for task in {run.task for run in runs if run.dataset == UNDISTURBED.format(task=run.task)}:
        record_dataset(UNDISTURBED.format(task=task), task, "undisturbed")


def print_tables(results: Path, form: str) -> None:
    """Print the tables as ``markdown`` or ``json``, or the ``findings``."""
    from dynmap_rl.paper import findings, tables
    from dynmap_rl.paper.results import read_cells

    cells = read_cells(results, TABLES)
    if form == "json":
        print(json.dumps(tables.table_rows(cells), indent=1))
    elif form == "markdown":
        print(tables.markdown_tables(cells))
    else:
        rows = findings.compare_cells(cells)
        print("\n\n".join([findings.markdown_claims(rows), findings.markdown_comparisons(rows)]))


def write_page(config: Config) -> None:
    """Write ``report.html`` with the tables so far into the folder of the runs."""
    from dynmap_rl.paper.results import read_cells
    from dynmap_rl.paper.tables import markdown_tables
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import plain_settings

    text, settings = markdown_tables(read_cells(config.results, TABLES)), plain_settings(config)
    print(f"written: {write_html(config.runs, 'Tables', text, command_line(sys.argv), settings)}")


def write_tables(config: Config) -> None:
    """Write the README of the repository's results, and the table in the main README."""
    from dynmap_rl.paper.page import write_results_page

    refuse(config, Config(), ("results",), "--write")
    changed = write_results_page(RESULTS, RECIPES.parent / "README.md")
    print("\n".join(f"written: {path}" for path in changed) or "nothing has changed")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
