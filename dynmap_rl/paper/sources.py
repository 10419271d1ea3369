"""Where the dynamics come from, and how many demonstrations: the runs of the grid, and the datasets they train on."""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from dynmap_rl.data.demonstrations import DERIVED
from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.training.dataset import find_or_record
from dynmap_rl.utils.files import read_json, write_json

from .cells import TASKS, Run

POLICIES = "recurrent", "feedforward"
WORLD_MODELS = 0, 1, 2  # seeds
SIZES = 30, 100, 300, 1000  # demonstrations
SUPERVISION = "position,velocity"
COMMAND = {"columns": [0, 1, 2], "angles": [2]}  # entries of the state: what the robot knows of itself
TURN = 5  # rad of noise on an angle for a metre of noise on a position


@dataclass(frozen=True)
class Source:
    """A source of dynamics.

    Attributes:
        text: name in tables and figures.
        columns: arguments of :func:`dynmap_rl.data.add_dynamics`; None leaves the recorded columns.
        options: options of ``recipes/decoupled.py``.
        supervision: dynamics that the world model is trained on.
    """

    text: str
    columns: dict | None = None
    options: tuple[str, ...] = ()
    supervision: str = SUPERVISION


def _derived(method: str, noise: int) -> Source:
    columns = {"state": "dynamics.position", "angles": [2, 5], "method": method}
    if noise:
        columns |= {"noise": noise / 1000, "angle_noise": TURN * noise / 1000}
    return Source(f"{method}, noise of {noise} mm", columns)


SOURCES = {
    "simulator": Source("simulator"),
    "none": Source("none (Only-RGB)", supervision="none"),
    **{f"{method}_{mm}": _derived(method, mm) for method in ("central", "savgol") for mm in (0, 2, 5, 10)},
    "centroid": Source("frames: centroid", {"source": "centroid"}),
    "tracks": Source("frames: tracks", {"source": "tracks"}),
    "flow": Source("frames: tracks and flow", {"source": "flow"}),
    **{
        f"labelled_{share}": Source(
            f"{share} % of the episodes", None, ("--world_model.labelled", str(share / 100))
        )
        for share in (5, 10, 25, 50)
    },
    "command": Source("commanded cart pose", COMMAND),
    "command_tracks": Source("commanded cart pose, and tracks", COMMAND | {"source": "state,tracks"}),
    "informed": Source("simulator, no RGB loss", None, ("--world_model.beta_rgb", "0")),
}
COPIES = "_copies"  # end of the names of rows whose policies are also trained on augmented copies
DATA_ROWS = {
    "none": "Only-RGB",
    "tracks": "RGB+[P+V], tracked",
    "simulator": "RGB+[P+V]",
    f"none{COPIES}": "Only-RGB, 15 copies",
    f"simulator{COPIES}": "RGB+[P+V], 15 copies",
    "end_to_end": "End-to-End",
}


def list_source_runs(
    tasks: tuple[str, ...] = TASKS[:1],
    datasets: Path = Path("datasets/sources"),
    only: Container[str] = tuple(SOURCES),
    seeds: tuple[int, ...] = WORLD_MODELS,
    architecture: str = "glimpse",
) -> list[Run]:
    """Return the runs of the table, those that train world models first.

    Args:
        tasks: tasks of the runs. A task that is not in the plane has only the sources without columns of their own.
        datasets: folder of the derived datasets.
        only: sources to list.
        seeds: seeds of the world models.
        architecture: form of the world models; runs of another form have the same names and need other folders.
    """
    runs = []
    for task in tasks:
        planar = get_task(task).planar
        names = [name for name, s in SOURCES.items() if name in only and (planar or s.columns is None)]
        runs += [_train(task, name, seed, datasets, 300, architecture) for seed in seeds for name in names]
    return runs + [_reuse(run) for run in runs]


def list_data_runs(
    datasets: Path = Path("datasets/sources"),
    only: Container[str] = tuple(DATA_ROWS),
    seeds: tuple[int, ...] = WORLD_MODELS,
    architecture: str = "glimpse",
) -> list[Run]:
    """Return the runs of the amount of data on task 1; those of 300 demonstrations are runs of the table too.

    Args:
        datasets: folder of the datasets.
        only: rows to list.
        seeds: seeds of the world models; the run of end-to-end training has its own.
        architecture: form of the world models.
    """
    runs = []
    for size in SIZES:
        names = [name for name in DATA_ROWS if name in only and name != "end_to_end"]
        runs += [
            _train(TASKS[0], name, seed, datasets, size, architecture) for seed in seeds for name in names
        ]
        if "end_to_end" in only:
            dataset = str(dataset_folder(TASKS[0], "simulator", datasets, size))
            arguments = ("--task", TASKS[0], "--dataset", dataset, "--eval.paper_episodes", "0")
            arguments += _form(architecture)
            name = name_run(TASKS[0], "end_to_end", 0, "recurrent", size)
            cell = TASKS[0], "joint", "recurrent", DATA_ROWS["end_to_end"]
            runs.append(Run(name, "end_to_end", cell, arguments, table="sources"))
    return runs


def name_run(task: str, source: str, seed: int, policy: str, size: int = 300) -> str:
    """Return the name of a run."""
    amount = "" if size == 300 else f"_{size}_demonstrations"
    model = "" if source == "end_to_end" else f"_world_model_{seed}"
    return f"{get_task(task).name}_{source}{amount}{model}_{policy}"


def find_table_runs(tables: Path, architecture: str = "glimpse") -> dict[str, Path]:
    """Return results of runs of the paper's tables that are of this grid too, by the name of the run here.

    These are runs of task 1 with the simulator's dynamics, with none, and end to end.

    Args:
        tables: folder of the results of ``recipes/paper/tables.py``.
        architecture: form of the world models.
    """
    training, found = "decoupled" if architecture == "glimpse" else architecture, {}
    for source, seed, policy in product(("simulator", "none"), WORLD_MODELS, POLICIES):
        supervision, suffix = (
            SOURCES[source].supervision.replace(",", "_"),
            f"_world_model_{seed}" if seed else "",
        )
        found[name_run(TASKS[0], source, seed, policy)] = (
            tables / f"{TASKS[0]}_{training}_{supervision}_{policy}{suffix}.json"
        )
    form = "" if architecture == "glimpse" else f"_{architecture}"
    found[name_run(TASKS[0], "end_to_end", 0, "recurrent")] = (
        tables / f"{TASKS[0]}{form}_end_to_end_recurrent.json"
    )
    return {name: path for name, path in found.items() if path.exists()}


def dataset_folder(task: str, source: str, datasets: Path, size: int = 300) -> Path:
    """Return the folder of the dataset of a source; sources without columns of their own share the recording."""
    name = get_task(task).name
    if SOURCES[source].columns is None:
        return Path("datasets") / name if size == 300 else datasets / f"{name}_{size}"
    return datasets / (f"{name}_{source}" if size == 300 else f"{name}_{size}_{source}")


def make_datasets(runs: list[Run], datasets: Path, workers: int = 1) -> None:
    """Record and derive the datasets of runs that are missing.

    Args:
        runs: runs of :func:`list_source_runs` and :func:`list_data_runs`.
        datasets: folder of the derived datasets.
        workers: processes that record.
    """
    wanted = {run.arguments[run.arguments.index("--dataset") + 1]: run.task for run in runs}
    for task in sorted(set(wanted.values())):
        for size in SIZES:
            recording = dataset_folder(task, "simulator", datasets, size)
            for name, source in SOURCES.items():
                folder = dataset_folder(task, name, datasets, size)
                if str(folder) not in wanted:
                    continue
                if size == 300:
                    find_or_record(task)
                else:
                    record_dataset(recording, task, episodes=size, workers=workers)
                if source.columns is not None and not folder.exists():
                    print(f"deriving {folder}", flush=True)
                    add_dynamics(recording, folder, **source_columns(task, name), replace=True)


def source_columns(task: str, source: str) -> dict:
    """Return the arguments of :func:`dynmap_rl.data.add_dynamics` that derive the columns of a source on a task.

    On task 3 the block falls through more than a turn, and its recorded angle never jumps. It is derived as a position is:
    noise of 5 mm is 5 mrad there, and 25 mrad for the other angles.
    """
    columns = SOURCES[source].columns
    if task == "bin_dropping" and columns.get("state") == "dynamics.position":
        return columns | {"angles": [2]}
    return columns


def copy_quality(runs: list[Run], results: Path) -> None:
    """Copy the quality of the runs' derived datasets to ``quality/DATASET.json`` in the folder of the results."""
    for folder in {Path(run.dataset) for run in runs if run.dataset}:
        if (judged := folder / DERIVED).exists():
            write_json(results / "quality" / f"{folder.name}.json", read_json(judged))


def _form(architecture: str) -> tuple[str, ...]:
    return () if architecture == "glimpse" else ("--world_model.architecture", architecture)


def _train(
    task: str, name: str, seed: int, datasets: Path, size: int = 300, architecture: str = "glimpse"
) -> Run:
    """Return the run that trains a world model and recurrent policies."""
    source = SOURCES[name.removesuffix(COPIES)]
    dataset = dataset_folder(task, name.removesuffix(COPIES), datasets, size)
    arguments = (
        "--task", task, "--dataset", str(dataset),
        "--world_model.supervision", source.supervision, "--eval.paper_episodes", "0",
        "--world_model.seed", str(seed), *source.options,
        *(("--policy.copies", "15") if name.endswith(COPIES) else ()),
    )  # fmt: skip
    arguments += _form(architecture)
    cell = task, "decoupled", "recurrent", source.text
    return Run(name_run(task, name, seed, "recurrent", size), "decoupled", cell, arguments, table="sources")


def _reuse(run: Run) -> Run:
    """Return the run that trains feed-forward policies on the world model of a recurrent run."""
    name = f"{run.name.removesuffix('recurrent')}feedforward"
    shared = run.arguments[: run.arguments.index("--world_model.seed")]
    task, training, _, row = run.cell
    return Run(
        name,
        run.recipe,
        (task, training, "feedforward", row),
        (*shared, "--policy.kind", "feedforward"),
        needs=run.name,
        table=run.table,
    )
