"""Compare sources of dynamics, and numbers of demonstrations, in closed loop.

    python recipes/paper/sources.py --dry_run
    python recipes/paper/sources.py --only tracks,none,simulator
    python recipes/paper/sources.py --part table --world_models 0
    python recipes/paper/sources.py --part data
    python recipes/paper/sources.py --part table --architecture plain   # a plain CNN, for which dynamics decide
    python recipes/paper/sources.py --write       # table and figures from the results alone

The table has a world model for each source of dynamics and seed, with recurrent and feed-forward policies (see
dynmap_rl/paper/sources.py). Its datasets are derived from the recordings of the tasks where they are missing. A run is
one of recipes/decoupled.py or end_to_end.py; a result is a JSON file, runs with a result are skipped, and the same
command resumes a stopped grid. Runs of recipes/paper/tables.py with the same training are not repeated. Every world
model is then measured by linear maps. The folder of the results gets README.md with the tables and the rank correlation
of the measures with success, and the figures.
"""

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dynmap_rl.utils.cli import command_line, run_recipe
from dynmap_rl.utils.settings import check_at_least, check_choice

RECIPES = Path(__file__).parents[1]
RESULTS = RECIPES / "results"


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Runs: table (sources), data (numbers of demonstrations, task 1), or all.
    part: str = "all"
    # Tasks of the table, with commas between.
    tasks: str = "balance_reaching"
    # Sources with commas between; by default all. --dry_run lists them in the names of the runs.
    only: str = ""
    # Seeds of the world models, with commas between.
    world_models: str = "0,1,2"
    # Form of the world models: glimpse, or plain.
    architecture: str = "glimpse"
    # Folder of the results; by default recipes/results/sources, or sources_plain.
    results: Path | None = None
    # Results of recipes/paper/tables.py that are of this grid too; by default recipes/results/cells, if --results
    # is not given.
    tables: Path | None = None
    # Folder of the runs; by default runs/sources, or runs/sources_plain.
    runs: Path | None = None
    # Folder of the derived datasets.
    datasets: Path = Path("datasets/sources")
    # Runs at a time; each takes two cores if it is alone, otherwise one.
    workers: int = 1
    # Demonstrations that the linear maps are fitted to.
    probe_episodes: int = 100
    # Folder with a settings file RECIPE.yaml for any of the recipes, passed to them as --config_path.
    presets: Path | None = None
    # List the runs with their minutes, and stop.
    dry_run: bool = False
    # Write tables and figures from the results alone, and stop.
    write: bool = False

    def __post_init__(self):
        check_choice(self, "part", ("table", "data", "all"))
        check_choice(self, "architecture", ("glimpse", "plain"))
        check_at_least(self, 1, "workers", "probe_episodes")
        if self.presets and not self.presets.is_dir():
            raise ValueError(f"--presets must be a folder, got {self.presets}")


def main(config: Config) -> None:
    """Execute the runs without a result, measure, and write."""
    name = "sources" if config.architecture == "glimpse" else f"sources_{config.architecture}"
    tables = config.tables or (None if config.results else RESULTS / "cells")
    config = replace(
        config, results=config.results or RESULTS / name, runs=config.runs or Path("runs") / name
    )
    from dynmap_rl.paper.launch import execute, has_run, is_done, launch, print_runs
    from dynmap_rl.paper.sources import copy_quality, find_table_runs, make_datasets
    from dynmap_rl.utils.files import read_json, write_json

    if config.write:
        return write(config)
    runs = choose_runs(config)
    shared = find_table_runs(tables, config.architecture) if tables else {}
    todo = [run for run in runs if not is_done(run.name, config.results)]
    shared = {run.name: shared[run.name] for run in todo if run.name in shared}
    todo = [run for run in todo if run.name not in shared]
    needed = {run.needs for run in todo if run.needs and not has_run(run.needs, config.runs)}
    todo = [run for run in runs if run in todo or run.name in needed]
    if config.dry_run:
        return print_runs(runs, todo)
    for name, path in shared.items():
        write_json(config.results / f"{name}.json", read_json(path))
    make_datasets(todo, config.datasets, workers=2 if config.workers == 1 else config.workers)
    start = partial(
        execute, recipes=RECIPES, results=config.results, runs=config.runs,
        threads=2 if config.workers == 1 else 1, presets=config.presets, root=Path.cwd(),
    )  # fmt: skip
    failed = launch(todo, start, workers=config.workers)
    copy_quality(runs, config.results)
    measure(config, runs)
    if len(failed) < len(runs):  # something is there to write
        write(config)
    if failed:
        raise ValueError("; ".join(failed))
    return None


def choose_runs(config: Config) -> list:
    """Return the runs of the settings; those that train world models come first."""
    from dynmap_rl.paper.sources import DATA_ROWS, SOURCES, WORLD_MODELS, list_data_runs, list_source_runs

    only = set(config.only.split(",")) if config.only else {*SOURCES, *DATA_ROWS}
    if unknown := only - {*SOURCES, *DATA_ROWS}:
        names = ",".join(dict.fromkeys([*SOURCES, *DATA_ROWS]))
        raise ValueError(f"--only must be any of {names}, got {','.join(sorted(unknown))}")
    given = config.world_models.split(",")
    if not set(given) <= {*map(str, WORLD_MODELS)}:
        raise ValueError(f"--world_models must be any of 0,1,2, got {config.world_models}")
    tasks, seeds = tuple(config.tasks.split(",")), tuple(map(int, given))
    form, runs = config.architecture, []
    runs += list_source_runs(tasks, config.datasets, only, seeds, form) if config.part != "data" else []
    runs += list_data_runs(config.datasets, only, seeds, form) if config.part != "table" else []
    unique = {run.name: run for run in runs}
    if not unique:
        raise ValueError(f"--part {config.part} has no runs of --only {config.only}; see --dry_run")
    return sorted(unique.values(), key=lambda run: run.needs is not None)


def measure(config: Config, runs: list) -> None:
    """Measure the world models that were trained here, on the recorded dynamics."""
    from dynmap_rl.data.demonstrations import load_demonstrations
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.paper.launch import has_run
    from dynmap_rl.paper.source_results import measure_world_model
    from dynmap_rl.runs.lookup import load_world_model_of
    from dynmap_rl.training.dataset import find_or_record
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit
    from dynmap_rl.utils.weights import fingerprint

    for task in sorted({run.task for run in runs if get_task(run.task).planar}):
        own = [c for c in runs if c.task == task and c.recipe == "decoupled" and not c.needs]
        paths = {c.name: config.results / "measures" / f"{c.name}.json" for c in own}
        todo = [name for name, path in paths.items() if has_run(name, config.runs) and not path.exists()]
        if not todo:
            continue
        episodes, _ = load_demonstrations(find_or_record(task))
        for name in todo:
            model, _ = load_world_model_of(config.runs / name)
            found = measure_world_model(model, episodes["train"][: config.probe_episodes], episodes["eval"])
            found |= {"world_model_sha256": fingerprint(model)}
            write_json(paths[name], found | {"command": command_line(sys.argv), "commit": find_commit()})


def write(config: Config) -> None:
    """Write README.md and the figures, of all tasks with results, into the folder of the results."""
    from dynmap_rl.envs.tasks import TASKS
    from dynmap_rl.paper.source_page import write_source_page

    tasks = [*dict.fromkeys([*TASKS, *config.tasks.split(",")])]
    if not any(config.results.glob("*.json")):
        raise ValueError(f"{config.results} must have results; run recipes/paper/sources.py first")
    print(
        "\n".join(
            f"written: {path}" for path in write_source_page(config.results, tasks, config.architecture)
        )
    )


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
