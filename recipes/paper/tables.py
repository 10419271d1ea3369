"""Run the grid of the paper's Tables I, II and III cell by cell, and print the tables.

    python recipes/paper/tables.py --dry_run                  # cells, those that are complete, remaining time
    python recipes/paper/tables.py --results runs/results     # a grid of your own
    python recipes/paper/tables.py --table II,III             # cells of some tables
    python recipes/paper/tables.py --only balance_reaching_decoupled_position --workers 2
    python recipes/paper/tables.py --launcher ray             # on a Ray cluster (pip install '.[ray]')
    python recipes/paper/tables.py --print markdown           # tables from the results alone; or json, findings
    python recipes/paper/tables.py --write                    # recipes/results/README.md from the results alone

A cell is a run of another recipe, and its result a JSON file in the folder of the results; cells with a result are
skipped. World models are trained once and reused. The same command resumes a stopped grid. The page report.html in the
folder of the runs shows the tables so far.
"""

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.paper.cells import TABLES, Cell, list_cells
from dynmap_rl.paper.launch import has_run, is_done, launch, run_cell
from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.cluster import LAUNCHERS, check_launcher
from dynmap_rl.utils.settings import check_at_least

RECIPES = Path(__file__).parents[1]
RESULTS = RECIPES / "results"


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Folder of the cells' results; by default those of the repository.
    results: Path = RESULTS / "cells"
    # Folder of the cells' runs.
    runs: Path = Path("runs/tables")
    # Tables whose cells are run: any of I,II,III.
    table: str = ",".join(TABLES)
    # Cell to run: its name, or a part of several names.
    only: str = ""
    # Cells at a time on this machine; each takes two cores if it is alone, otherwise one.
    workers: int = 1
    # local, or ray: the cluster of RAY_ADDRESS, or one on this machine. All machines must share this folder.
    launcher: str = "local"
    # CPUs of a cell, with --launcher ray.
    cpus: float = 2
    # GPUs of a cell, with --launcher ray.
    gpus: float = 0
    # Folder with a settings file RECIPE.yaml for any of the recipes, passed to their cells as --config_path.
    presets: Path | None = None
    # List the cells and stop.
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
    """Run the cells without a result, or print or write the tables."""
    if config.print:
        return print_tables(config.results, config.print)
    if config.write:
        return write_tables(config)
    ignored = {"local": ("cpus", "gpus"), "ray": ("workers",)}[config.launcher]
    refuse(config, Config(), ignored, f"--launcher {config.launcher}")
    cells, todo, sources = choose_cells(config)
    if config.dry_run:
        return print_cells(cells, todo, sources)
    from dynmap_rl.training.dataset import find_or_record

    if not todo:
        print(
            f"nothing to do: {len(cells)} cells are in {config.results}; choose another --results for a new grid"
        )
        return write_page(config)
    check_launcher(config.launcher)  # recording takes minutes
    for task in {cell.task for cell in sources + todo}:  # cells must not record at the same time
        find_or_record(task)
    cores = config.cpus if config.launcher == "ray" else 2 if config.workers == 1 else 1
    run = partial(
        run_cell, recipes=RECIPES, results=config.results, runs=config.runs, threads=int(cores),
        presets=config.presets, root=Path.cwd(),
    )  # fmt: skip
    start = partial(
        launch, run=run, launcher=config.launcher, workers=config.workers, cpus=config.cpus, gpus=config.gpus
    )
    failed = start([*sources, *(cell for cell in todo if not cell.needs)])
    ready = [cell for cell in todo if cell.needs and has_run(cell.needs, config.runs)]
    missing = [cell.name for cell in todo if cell.needs and cell not in ready]
    failed += start(ready) + [f"{name} needs the world model of a failed cell" for name in missing]
    write_page(config)
    if failed:
        raise ValueError("; ".join(failed))
    return None


def choose_cells(config: Config) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """Return the chosen cells, those without a result, and the cells whose world models must be trained first."""
    cells = list_cells()
    candidates = [cell for cell in cells if cell.table in config.table.split(",")]
    chosen = [cell for cell in candidates if cell.name == config.only]
    chosen = chosen or [cell for cell in candidates if config.only in cell.name]
    if not chosen:
        raise ValueError(
            f"--only must be a part of a cell's name, got {config.only!r}; --dry_run lists the names"
        )
    todo = [cell for cell in chosen if not is_done(cell.name, config.results)]
    needed = {cell.needs for cell in todo if cell.needs and not has_run(cell.needs, config.runs)}
    return chosen, todo, [cell for cell in cells if cell.name in needed and cell not in todo]


def print_cells(cells: list[Cell], todo: list[Cell], sources: list[Cell]) -> None:
    """Print all cells with their minutes, and the remaining time."""
    for cell in [*sources, *cells]:
        print(f"{f'{cell.minutes:3} min' if cell in sources + todo else '   done'}  {cell.name}")
    hours, done = sum(cell.minutes for cell in sources + todo) / 60, len(cells) - len(todo)
    print(f"{done} of {len(cells)} cells are complete; about {hours:.1f} hours of one core are left")


def print_tables(results: Path, form: str) -> None:
    """Print the tables as ``markdown`` or ``json``, or the ``findings``."""
    from dynmap_rl.paper import findings, tables

    if form == "json":
        print(json.dumps(tables.table_rows(results), indent=1))
    elif form == "markdown":
        print(tables.markdown_tables(results))
    else:
        rows = findings.compare_cells(results)
        parts = findings.markdown_claims(rows), findings.markdown_comparisons(rows)
        print("\n\n".join([*parts, findings.markdown_spread(results)]))


def write_page(config: Config) -> None:
    """Write ``report.html`` with the tables so far into the folder of the runs."""
    from dynmap_rl.paper.tables import markdown_tables
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import plain_settings

    text, settings = markdown_tables(config.results), plain_settings(config)
    print(f"written: {write_html(config.runs, 'Tables I to III', text, command_line(sys.argv), settings)}")


def write_tables(config: Config) -> None:
    """Write the README of the repository's results, and the table in the main README."""
    from dynmap_rl.paper.page import write_results_page

    refuse(config, Config(), ("results",), "--write")
    changed = write_results_page(RESULTS, RECIPES.parent / "README.md")
    print("\n".join(f"written: {path}" for path in changed) or "nothing has changed")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
