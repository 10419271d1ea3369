"""Results of the cells of the tables, read from a folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from dynmap_rl.evaluation.protocol import result_rows, unpack_rows
from dynmap_rl.evaluation.statistics import shared_interval, student_interval, summarize, summarize_seeds
from dynmap_rl.utils.files import read_json

from .cells import Key, Run, list_runs
from .published import TABLES, find_numbers

ROWS = list(TABLES["bin_dropping", "joint", "recurrent"])  # in the paper's order, End-to-End first
COLUMNS = {  # table: its columns, as (task, training, policy)
    "I": [key for key in TABLES if key[0] == "balance_reaching"],
    "II": [key for key in TABLES if key[0] == "balance_reaching_obstacle"],
    "III": [key for key in TABLES if key[0] == "bin_dropping"],
}


@dataclass(frozen=True)
class Cell:
    """Results of all runs of a cell that are complete.

    Attributes:
        key: task, training, policy and row.
        table: table of the cell.
        results: ``eval.json`` of each complete run.
        missing: number of runs without a result.
    """

    key: Key
    table: str
    results: tuple[dict, ...]
    missing: int = 0

    @property
    def row(self) -> str:
        """Name of the row."""
        return self.key[-1]

    @cached_property
    def world_models(self) -> list[list[list[dict]]]:
        """Episode rows on the shared start states, by world model and policy.

        Each seed of joint and end-to-end training on task 1 has a world model of its own.
        """
        found = []
        for result in self.results:
            policies = result_rows(result)
            # A run on a frozen world model names its fingerprint.
            found += [policies] if result.get("world_model_sha256") else [[rows] for rows in policies]
        return found

    @property
    def policies(self) -> list[list[dict]]:
        """Episode rows on the shared start states, by policy."""
        return [rows for policies in self.world_models for rows in policies]

    @property
    def fingerprints(self) -> list[str]:
        """Fingerprints of the world models, in their order."""
        found = []
        for result in self.results:
            frozen = result.get("world_model_sha256")
            found += [frozen] if frozen else [seed["world_model_sha256"] for seed in result["results"]]
        return found

    def rates(self, outcome: str = "success") -> list[float]:
        """Return the mean of an outcome for each world model, over its policies (%, or mm of ``position_error``)."""
        scale = 1000 if outcome == "position_error" else 100
        return [
            scale * float(np.mean([[row[outcome] for row in rows] for rows in policies]))
            for policies in self.world_models
        ]

    @cached_property
    def summary(self) -> dict:
        """Summary over all policies on the shared start states.

        ``DR`` (%), ``PE`` (mm), ``SR`` (%), ``episodes``; 95 % ``SR_interval`` and ``DR_interval`` over scenes;
        ``world_models``, the SR of each; ``world_model_interval``, the 95 % interval of their mean, or None for fewer than two.
        """
        rates = self.rates()
        return summarize([row for rows in self.policies for row in rows]) | {
            "SR_interval": shared_interval(self.policies),
            "DR_interval": shared_interval(self.policies, "dropped"),
            "world_models": rates,
            "world_model_interval": student_interval(rates),
        }

    @cached_property
    def protocol(self) -> dict[str, tuple[float, float]] | None:
        """Mean and standard deviation over the policies by the paper's protocol; None where it was not run."""
        seeds = [seed for result in self.results for seed in result["results"]]
        if not all("paper" in seed for seed in seeds):
            return None
        return summarize_seeds([unpack_rows(seed["paper"]["rows"]) for seed in seeds])

    @property
    def published(self) -> dict[str, tuple[float, float]] | None:
        """The paper's mean and standard deviation of each metric; None where the paper has no such cell."""
        return find_numbers(*self.key)


def read_cells(results: Path, tables: Iterable[str] = tuple(COLUMNS)) -> dict[Key, Cell]:
    """Read the results of all cells of some tables; a cell without a complete run is there too.

    Args:
        results: folder with the ``eval.json`` of every complete run, as ``NAME.json``.
        tables: names of the tables; by default the paper's.

    Returns:
        The cells by task, training (``decoupled``, or ``joint``, which includes end-to-end), policy and row.
    """
    runs: dict[Key, list[Run]] = {}
    for run in list_runs():
        if run.table in tables:
            runs.setdefault(run.cell, []).append(run)
    return {key: _read_cell(results, key, of_cell) for key, of_cell in runs.items()}


def _read_cell(results: Path, key: Key, runs: list[Run]) -> Cell:
    found = read_on_same_scenes([results / f"{run.name}.json" for run in runs])
    return Cell(key, runs[0].table, tuple(found), len(runs) - len(found))


def read_on_same_scenes(paths: Iterable[Path]) -> list[dict]:
    """Read those results that are there; they must be on the same start states.

    Raises:
        ValueError: two are on others.
    """
    found = {path: read_json(path) for path in paths if path.exists()}
    first = None  # result, and its scenes, which follow each other
    for path, result in found.items():
        for seed in result["results"]:
            rows = seed["test"]["rows"]
            scenes = rows["first_scene_seed"], len(rows["success"])
            first = first or (path, scenes)
            if scenes != first[1]:
                raise ValueError(
                    f"{path} must have the same scenes as {first[0]}; evaluate it again or remove it"
                )
    return list(found.values())


def find_repeated(folder: Path) -> list[str]:
    """Return the runs whose frozen world model is of another training of the run that they name, which was repeated.

    Args:
        folder: see :func:`read_cells`.
    """
    found = []
    for run in list_runs():
        path, source = folder / f"{run.name}.json", folder / f"{run.needed_run}.json"
        if not (run.needs and path.exists() and source.exists()):
            continue
        named = read_json(source)
        seed = int(run.needs.partition("/seed_")[2] or 0)
        if read_json(path)["world_model_sha256"] not in (
            named.get("world_model_sha256"), named["results"][seed].get("world_model_sha256"),
        ):  # fmt: skip
            found.append(run.name)
    return found


def count_commits(cells: Iterable[Cell]) -> Counter[str]:
    """Return how many runs of some cells each commit has made."""
    return Counter(str(result.get("commit")) for cell in cells for result in cell.results)


def count_devices(results: Iterable[dict]) -> Counter[str]:
    """Return how many results were computed on each GPU; those that name no device are of a CPU."""
    return Counter(result.get("device", "cpu") for result in results)
