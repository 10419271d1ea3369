"""Start of runs: each in a process of its own, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

from dynmap_rl.utils.cluster import check_launcher, connect
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.processes import run_script

from .cells import Run


def is_done(name: str, results: Path) -> bool:
    """Return whether a run has a result."""
    return (results / f"{name}.json").exists()


def has_run(name: str, runs: Path) -> bool:
    """Return whether a run is complete."""
    return (runs / name / "eval.json").exists()


def print_runs(runs: Sequence[Run], todo: Sequence[Run]) -> None:
    """Print all runs with the minutes of those that are to be executed, and the remaining time."""
    for run in runs:
        print(f"{f'{run.minutes:3} min' if run in todo else '   done'}  {run.name}")
    hours, done = sum(run.minutes for run in todo) / 60, sum(run not in todo for run in runs)
    print(f"{done} of {len(runs)} runs are complete; about {hours:.1f} hours of one core are left")


def find_missing(runs: Path, names: Sequence[str]) -> list[str]:
    """Return and print which runs of a folder are not complete.

    Raises:
        ValueError: none of them is complete.
    """
    missing = [name for name in names if not has_run(name, runs)]
    if not missing:
        return []
    how = f"{runs / missing[0]} must be a finished run; run python recipes/paper/tables.py --results runs/results"
    how += f" --only {missing[0]}" + (f" ({len(missing) - 1} more: without --only)" if missing[1:] else "")
    if len(missing) == len(names):
        raise ValueError(how)
    print(f"{len(names) - len(missing)} of {len(names)} runs are there: {how}")
    return missing


def execute(
    run: Run,
    recipes: Path,
    results: Path,
    runs: Path,
    *,
    threads: int = 2,
    presets: Path | None = None,
    root: Path = Path(),
) -> str | None:
    """Execute a run's recipe and keep its ``eval.json`` as the result.

    Args:
        run: run to execute.
        recipes: folder of the recipes.
        results: folder of the results.
        runs: folder of the runs; the recipe's output is appended to ``NAME.log`` beside the run.
        threads: threads of the recipe.
        presets: folder with a settings file ``RECIPE.yaml`` for any of the recipes, and ``RECIPE_pretrained.yaml`` for
            runs on the world model of another run.
        root: working directory of the recipe, to which the other folders are relative.

    Returns:
        None, or a message if the run failed.
    """
    folder, log = runs / run.name, root / runs / f"{run.name}.log"
    arguments = [*run.arguments, "--run", str(folder), "--compute.threads", str(threads)]
    if run.needs:
        arguments += ["--pretrained", str(runs / run.needs)]
    stems = [f"{run.recipe}_pretrained", run.recipe] if run.needs else [run.recipe]
    found = [path for stem in stems if presets and (path := root / presets / f"{stem}.yaml").exists()]
    arguments += ["--config_path", str(found[0])] if found else []
    log.parent.mkdir(parents=True, exist_ok=True)
    if run_script(recipes / f"{run.recipe}.py", arguments, root, log):
        last = (log.read_text(errors="replace").splitlines() or ["no output"])[-1]
        return f"{run.name} failed; see {folder}.log, which ends with: {last}"
    if not is_done(run.name, root / results):
        write_json(root / results / f"{run.name}.json", read_json(root / folder / "eval.json"))
    return None


def launch(
    runs: Sequence[Run],
    start: Callable[[Run], str | None],
    launcher: str = "local",
    *,
    workers: int = 1,
    cpus: float = 2,
    gpus: float = 0,
) -> list[str]:
    """Execute runs in order, and print the name of each that is done, or why it failed, as soon as it ends.

    A run whose world model comes from another one of them waits for that run, while later ones go ahead, and does not
    start if that one fails.

    Args:
        runs: runs to execute, first ones first; a world model's run comes before those that need it.
        start: function that executes a run and returns a message if it failed, such as :func:`execute` with its
            folders.
        launcher: ``local`` or ``ray``.
        workers: runs at a time, with ``local``.
        cpus: CPUs of a run, with ``ray``.
        gpus: GPUs of a run, with ``ray``.

    Returns:
        Messages of the runs that failed.

    Raises:
        ValueError: the launcher is unknown, or is ``ray`` and Ray is not installed.
    """
    check_launcher(launcher)
    if not runs:
        return []
    failed = []
    ends = launch_ray(runs, start, cpus, gpus) if launcher == "ray" else launch_local(runs, start, workers)
    for run, message in ends:
        failed += [message] if message else []
        print(message or f"done: {run.name}", flush=True)
    return failed


def launch_local(
    runs: Sequence[Run], start: Callable[[Run], str | None], workers: int = 1
) -> Iterator[tuple[Run, str | None]]:
    """Execute runs in threads, and yield them with their messages in the order in which they end."""
    todo, running, failed, ended = list(runs), {}, set(), SimpleQueue()
    with ThreadPoolExecutor(workers) as pool:  # threads that wait for processes
        try:
            while todo or running:
                open_names = {run.name for run in (*todo, *running.values())}
                ready = [run for run in todo if run.needed_run not in open_names]
                for run in ready[: workers - len(running)]:
                    todo.remove(run)
                    future = pool.submit(_start, run.needed_run in failed, start, run)
                    running[future] = run
                    future.add_done_callback(ended.put)
                future = ended.get()
                run, message = running.pop(future), future.result()
                if message:
                    failed.add(run.name)
                yield run, message
        except BaseException:  # Ctrl-C reaches the current runs too; no other may begin
            pool.shutdown(cancel_futures=True)
            raise


def launch_ray(
    runs: Sequence[Run], start: Callable[[Run], str | None], cpus: float = 2, gpus: float = 0
) -> Iterator[tuple[Run, str | None]]:
    """Execute runs on a Ray cluster, and yield them with their messages in the order in which they end."""
    import ray

    connect()
    remote, refs = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)(_start), {}
    for run in runs:  # Ray waits for the result that is an argument
        refs[run.name] = remote.remote(refs.get(run.needed_run), start, run)
    running = dict(zip(refs.values(), runs, strict=True))
    while running:
        (done,), _ = ray.wait(list(running))
        run = running.pop(done)
        try:
            yield run, ray.get(done)
        except ray.exceptions.RayError as error:
            yield run, f"{run.name} was lost by Ray ({type(error).__name__}); the same command resumes"


def _start(failed: bool | str | None, start: Callable[[Run], str | None], run: Run) -> str | None:
    """Execute a run, unless the run that it needs has failed."""
    return f"{run.name} needs the world model of a failed run" if failed else start(run)
