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
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.paper.cells import TABLES, Cell, list_cells
from dynmap_rl.utils.cli import command_line, refuse, run_recipe
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
        if self.launcher not in ("local", "ray"):
            raise ValueError(f"--launcher must be local or ray, got {self.launcher!r}")
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
    for task in {cell.task for cell in sources + todo}:  # cells must not record at the same time
        find_or_record(task)
    failed = launch([*sources, *(cell for cell in todo if not cell.needs)], config)
    ready = [cell for cell in todo if cell.needs and has_run(cell.needs, config)]
    missing = [cell.name for cell in todo if cell.needs and cell not in ready]
    failed += launch(ready, config) + [f"{name} needs the world model of a failed cell" for name in missing]
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
    todo = [cell for cell in chosen if not is_done(cell, config)]
    needed = {cell.needs for cell in todo if cell.needs and not has_run(cell.needs, config)}
    return chosen, todo, [cell for cell in cells if cell.name in needed and cell not in todo]


def is_done(cell: Cell, config: Config, root: Path = Path()) -> bool:
    """Return whether a cell has a result."""
    return (root / config.results / f"{cell.name}.json").exists()


def has_run(name: str, config: Config) -> bool:
    """Return whether the run of a cell is complete."""
    return (config.runs / name / "eval.json").exists()


def launch(cells: list[Cell], config: Config) -> list[str]:
    """Run cells that do not depend on each other, and return the messages of those that failed."""
    failed = []
    launcher = launch_ray if config.launcher == "ray" else launch_local
    for cell, message in launcher(cells, config) if cells else ():
        if message:
            failed.append(message)
        else:
            print(f"done: {cell.name}", flush=True)
    return failed


def launch_local(cells: list[Cell], config: Config) -> Iterator[tuple[Cell, str | None]]:
    """Run every cell in a process of its own, and yield cells with their messages in the order in which they end."""
    with ThreadPoolExecutor(config.workers) as pool:  # threads that wait for processes
        try:
            running = {pool.submit(run_cell, cell, config, Path.cwd()): cell for cell in cells}
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:  # Ctrl-C reaches the running cells too; no other may begin
            pool.shutdown(cancel_futures=True)
            raise


def launch_ray(cells: list[Cell], config: Config) -> Iterator[tuple[Cell, str | None]]:
    """Run every cell on a Ray cluster, and yield cells with their messages in the order in which they end.

    Raises:
        ValueError: Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError("--launcher ray needs Ray: pip install '.[ray]'") from error
    if not ray.is_initialized():
        ray.init(log_to_driver=False)
    remote = ray.remote(num_cpus=config.cpus, num_gpus=config.gpus, max_retries=0)(run_cell)
    running = {remote.remote(cell, config, Path.cwd()): cell for cell in cells}
    while running:
        (done,), _ = ray.wait(list(running))
        cell = running.pop(done)
        try:
            yield cell, ray.get(done)
        except ray.exceptions.RayError as error:
            yield cell, f"{cell.name} was lost by Ray ({type(error).__name__}); the same command resumes"


def run_cell(cell: Cell, config: Config, root: Path) -> str | None:
    """Run the recipe of a cell in ``root`` and keep its ``eval.json``; return a message if the run failed."""
    from dynmap_rl.utils.files import read_json, write_json
    from dynmap_rl.utils.processes import run_script

    folder, log = config.runs / cell.name, root / config.runs / f"{cell.name}.log"
    cores = config.cpus if config.launcher == "ray" else 2 if config.workers == 1 else 1
    arguments = [*cell.arguments, "--run", str(folder), "--compute.threads", str(int(cores))]
    if cell.needs:
        arguments += ["--pretrained", str(config.runs / cell.needs)]
    if config.presets and (preset := root / config.presets / f"{cell.recipe}.yaml").exists():
        arguments += ["--config_path", str(preset)]
    log.parent.mkdir(parents=True, exist_ok=True)
    if run_script(RECIPES / f"{cell.recipe}.py", arguments, root, log):
        last = (log.read_text(errors="replace").splitlines() or ["no output"])[-1]
        return f"{cell.name} failed; see {config.runs / cell.name}.log, which ends with: {last}"
    if not is_done(cell, config, root):
        write_json(root / config.results / f"{cell.name}.json", read_json(root / folder / "eval.json"))
    return None


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
