"""Runs of cells: each in a process of its own, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from dynmap_rl.utils.cluster import check_launcher, run_by_ray
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import run_script

from .cells import Cell


def is_done(name: str, results: Path) -> bool:
    """Return whether a cell has a result."""
    return (results / f"{name}.json").exists()


def has_run(name: str, runs: Path) -> bool:
    """Return whether the run of a cell is complete."""
    return (runs / name / "eval.json").exists()


def run_cell(
    cell: Cell,
    recipes: Path,
    results: Path,
    runs: Path,
    *,
    threads: int = 2,
    presets: Path | None = None,
    root: Path = Path(),
) -> str | None:
    """Run the recipe of a cell and keep its ``eval.json`` as the cell's result.

    Args:
        cell: cell to run.
        recipes: folder of the recipes.
        results: folder of the results.
        runs: folder of the runs; the recipe's output is appended to ``NAME.log`` beside the run.
        threads: threads of the recipe.
        presets: folder with a settings file ``RECIPE.yaml`` for any of the recipes.
        root: working directory of the recipe, to which the other folders are relative.

    Returns:
        None, or a message if the run failed.
    """
    folder, log = runs / cell.name, root / runs / f"{cell.name}.log"
    arguments = [*cell.arguments, "--run", str(folder), "--compute.threads", str(threads)]
    if cell.needs:
        arguments += ["--pretrained", str(runs / cell.needs)]
    if presets and (preset := root / presets / f"{cell.recipe}.yaml").exists():
        arguments += ["--config_path", str(preset)]
    log.parent.mkdir(parents=True, exist_ok=True)
    if run_script(recipes / f"{cell.recipe}.py", arguments, root, log):
        last = (log.read_text(errors="replace").splitlines() or ["no output"])[-1]
        return f"{cell.name} failed; see {runs / cell.name}.log, which ends with: {last}"
    if not is_done(cell.name, root / results):
        write_json(root / results / f"{cell.name}.json", read_json(root / folder / "eval.json"))
    return None


def launch(
    cells: Sequence[Cell],
    run: Callable[[Cell], str | None],
    launcher: str = "local",
    *,
    workers: int = 1,
    cpus: float = 2,
    gpus: float = 0,
) -> list[str]:
    """Run cells that do not depend on each other, and print the name of each that is done.

    Args:
        cells: cells to run.
        run: function that runs a cell and returns a message if it failed, such as :func:`run_cell` with its folders.
        launcher: ``local`` or ``ray``.
        workers: cells at a time, with ``local``.
        cpus: CPUs of a cell, with ``ray``.
        gpus: GPUs of a cell, with ``ray``.

    Returns:
        Messages of the cells that failed.

    Raises:
        ValueError: the launcher is unknown, or is ``ray`` and Ray is not installed.
    """
    check_launcher(launcher)
    if not cells:
        return []
    failed = []
    ends = launch_ray(cells, run, cpus, gpus) if launcher == "ray" else launch_local(cells, run, workers)
    for cell, message in ends:
        if message:
            failed.append(message)
        else:
            print(f"done: {cell.name}", flush=True)
    return failed


def launch_local(
    cells: Sequence[Cell], run: Callable[[Cell], str | None], workers: int = 1
) -> Iterator[tuple[Cell, str | None]]:
    """Run cells in threads, and yield them with their messages in the order in which they end."""
    with ThreadPoolExecutor(workers) as pool:  # threads that wait for processes
        try:
            running = {pool.submit(run, cell): cell for cell in cells}
            for future in as_completed(running):
                yield running[future], future.result()
        except BaseException:  # Ctrl-C reaches the running cells too; no other may begin
            pool.shutdown(cancel_futures=True)
            raise


def launch_ray(
    cells: Sequence[Cell], run: Callable[[Cell], str | None], cpus: float = 2, gpus: float = 0
) -> Iterator[tuple[Cell, str | None]]:
    """Run cells on a Ray cluster, and yield them with their messages in the order in which they end."""
    for cell, end in run_by_ray(run, cells, cpus, gpus):
        try:
            yield cell, end()
        except OSError as error:
            yield cell, f"{cell.name}: {error}"
