"""Run the whole grid of the paper's Tables I, II and III, cell by cell, and print the tables.

    python recipes/tables.py --dry_run                  # the cells, what is done, the time that is left
    python recipes/tables.py                            # all of them, one after the other
    python recipes/tables.py --table II,III             # those of these tables, and the world models that they need
    python recipes/tables.py --only balance_reaching_decoupled_position --workers 2
    python recipes/tables.py --launcher ray             # on a Ray cluster (pip install '.[ray]')
    python recipes/tables.py --print markdown           # or json: the tables from the results alone

A cell is a run of another recipe; its result is a JSON in ``results``. Cells whose result is there are skipped, so that a
grid of your own needs a folder of its own (``--results runs/results``). World models are trained once and reused; one that a
cell needs and whose run is not there is trained first. A killed run loses at most what its cells in flight have not saved
yet; the same command goes on. A page in the folder of the runs, `report.html`, shows the tables so far.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

from dynmap_rl.paper.cells import TABLES
from dynmap_rl.paper.cells import Cell
from dynmap_rl.paper.cells import list_cells
from dynmap_rl.utils.cli import check_at_least_one
from dynmap_rl.utils.cli import refuse
from dynmap_rl.utils.cli import replace_defaults
from dynmap_rl.utils.cli import run_recipe
from dynmap_rl.utils.processes import run_script

RECIPES = Path(__file__).parent
SMOKE = Path("runs/tables_smoke")


@dataclass
class Config:
    # Folder of the cells' results; by default those that come with the repository.
    results: Path = RECIPES / "results"
    # Folder of the cells' runs.
    runs: Path = Path("runs/tables")
    # Only the cells of these of the paper's tables: I, II, III, or several with commas between.
    table: str = ",".join(TABLES)
    # Only the cell of this name, or those whose name holds it.
    only: str = ""
    # Cells at a time on this machine; each takes two cores if it is alone, otherwise one.
    workers: int = 1
    # local, or ray: the cluster that RAY_ADDRESS names, or one on this machine. Its machines share this folder.
    launcher: str = "local"
    # CPUs that Ray sets aside for a cell.
    cpus: float = 2
    # GPUs that Ray sets aside for a cell.
    gpus: float = 0
    # List the cells and stop.
    dry_run: bool = False
    # Print the tables as markdown or json, or the findings (claims of the paper, tested), and stop.
    print: str | None = None
    # Every cell in a minimal size, for tests, in runs/tables_smoke.
    smoke: bool = False


def run_cell(cell: Cell, config: Config, root: Path) -> str | None:
    """Run the recipe in ``root``, where it goes on where it was stopped, and keep its ``eval.json``; a message if it
    failed."""
    from dynmap_rl.utils.files import read_json
    from dynmap_rl.utils.files import write_json

    folder, log = config.runs / cell.name, root / config.runs / f"{cell.name}.log"
    arguments = [*cell.arguments, "--run", str(folder)]
    if cell.needs:
        arguments += ["--world_model", str(config.runs / cell.needs)]
    cores = config.cpus if config.launcher == "ray" else 2 if config.workers == 1 else 1
    arguments += ["--threads", str(max(1, int(cores)))]
    arguments += ["--smoke"] if config.smoke else []
    log.parent.mkdir(parents=True, exist_ok=True)
    if run_script(RECIPES / f"{cell.recipe}.py", arguments, root, log):
        said = (log.read_text(errors="replace").splitlines() or ["nothing"])[-1]
        return f"{cell.name} failed; see {config.runs / cell.name}.log, which ends with: {said}"
    if not is_done(cell, config, root):
        write_json(root / config.results / f"{cell.name}.json", read_json(root / folder / "eval.json"))
    return None


def is_done(cell: Cell, config: Config, root: Path = Path()) -> bool:
    return (root / config.results / f"{cell.name}.json").exists()


def has_run(name: str, config: Config) -> bool:
    return (config.runs / name / "eval.json").exists()


def launch_local(cells: list[Cell], config: Config) -> Iterator[tuple[Cell, str | None]]:
    """Every cell with its message, in the order in which they end; each is a process of its own, which ends with this
    one."""
    with ThreadPoolExecutor(config.workers) as pool:  # threads that wait for processes
        try:
            running = {pool.submit(run_cell, cell, config, Path.cwd()): cell for cell in cells}
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:  # Ctrl-C has reached the cells in flight too; no other begins
            pool.shutdown(cancel_futures=True)
            raise


def launch_ray(cells: list[Cell], config: Config) -> Iterator[tuple[Cell, str | None]]:
    """The same on a Ray cluster.

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
            yield cell, f"{cell.name} was lost by Ray ({type(error).__name__}); the same command goes on"


LAUNCHERS = {"local": launch_local, "ray": launch_ray}


def launch(cells: list[Cell], config: Config) -> list[str]:
    """Run cells that do not depend on each other; the messages of those that failed."""
    failed = []
    for cell, message in LAUNCHERS[config.launcher](cells, config) if cells else ():
        if message:
            failed.append(message)
        else:
            print(f"done: {cell.name}", flush=True)
    return failed


def choose_cells(config: Config) -> tuple[list[Cell], list[Cell], list[Cell]]:
    """Those that ``table`` and ``only`` name, those of them to be run, and the world models they need whose run is not
    there."""
    cells, tables = list_cells(), {table.strip() for table in config.table.split(",")}
    if not tables <= set(TABLES):
        raise ValueError(f"--table is I, II or III, or several with commas between, not {config.table!r}")
    there = [cell for cell in cells if cell.table in tables]
    chosen = [cell for cell in there if cell.name == config.only]
    chosen = chosen or [cell for cell in there if config.only in cell.name]
    if not chosen:
        raise ValueError(f"no cell's name holds {config.only!r}; --dry_run lists them")
    todo = [cell for cell in chosen if not is_done(cell, config)]
    needed = {cell.needs for cell in todo if cell.needs and not has_run(cell.needs, config)}
    return chosen, todo, [cell for cell in cells if cell.name in needed and cell not in todo]


def check_config(config: Config) -> None:
    check_at_least_one(config, "workers", "cpus")
    if config.launcher not in LAUNCHERS:
        raise ValueError(f"--launcher is {' or '.join(LAUNCHERS)}, not {config.launcher!r}")
    ignored = {"local": ("cpus", "gpus"), "ray": ("workers",)}[config.launcher]
    refuse(config, ignored, f"says nothing to --launcher {config.launcher}")


def main(config: Config) -> None:
    if config.print:
        from dynmap_rl.paper.tables import print_tables

        return print_tables(config.results, config.print)
    check_config(config)
    if config.smoke:
        replace_defaults(config, {"results": SMOKE / "results", "runs": SMOKE})
    cells, todo, sources = choose_cells(config)
    if config.dry_run:
        for cell in [*sources, *cells]:
            print(f"{f'{cell.minutes:3} min' if cell in sources + todo else '   done'}  {cell.name}")
        hours = sum(cell.minutes for cell in sources + todo) / 60
        return print(
            f"{len(cells) - len(todo)} of {len(cells)} cells are done; about {hours:.1f} hours of one core are left"
        )
    from dynmap_rl.paper.tables import write_tables_page
    from dynmap_rl.training.dataset import find_or_record

    if not todo:
        print(
            f"nothing to do: {len(cells)} cells are in {config.results}; --results names a grid of your own"
        )
        return write_tables_page(config.runs, config.results, vars(config))
    for task in {cell.task for cell in sources + todo}:  # here, so that cells do not record at the same time
        find_or_record(SimpleNamespace(task=task, dataset=None, smoke=config.smoke))
    failed = launch([*sources, *(cell for cell in todo if not cell.needs)], config)
    ready = [cell for cell in todo if cell.needs and has_run(cell.needs, config)]
    missing = [cell.name for cell in todo if cell.needs and cell not in ready]
    failed += launch(ready, config) + [f"{name} waits for its world model" for name in missing]
    write_tables_page(config.runs, config.results, vars(config))
    if failed:
        raise ValueError("; ".join(failed))


if __name__ == "__main__":
    run_recipe(main, Config)
