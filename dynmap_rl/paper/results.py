"""Results of the cells of the paper's tables, read from a folder."""

from __future__ import annotations

from pathlib import Path

from dynmap_rl.utils.files import read_json

from .published import TABLES, paper_numbers

Key = tuple[str, str, str, str]  # task, training, policy, row
ROWS = list(TABLES["bin_dropping", "joint", "recurrent"])  # in the paper's order, End-to-End first
COLUMNS = {  # table: its columns, as (task, training, policy)
    "I": [key for key in TABLES if key[0] == "balance_reaching"],
    "II": [key for key in TABLES if key[0] == "balance_reaching_obstacle"],
    "III": [key for key in TABLES if key[0] == "bin_dropping"],
}


def read_cells(results: Path, world_model_seed: int = 0) -> dict[Key, dict]:
    """Read the results of all cells that the paper has too.

    Args:
        results: folder with an ``eval.json`` of a run for each cell, under any name.
        world_model_seed: seed of the decoupled world models.

    Returns:
        The results by task, training (``decoupled``, or ``joint``, which includes end-to-end), policy and row.
    """
    cells = {}
    for path in sorted(results.glob("*.json")):
        result = read_json(path)
        if "world_model" not in result or _world_model_seed(result["settings"]) != world_model_seed:
            continue
        if paper_numbers(result):
            training = "decoupled" if result["world_model"]["training"] == "decoupled" else "joint"
            cells[result["task"], training, result["policy"], result["row"]] = result
    return cells


def _world_model_seed(settings: dict) -> int:
    nested = settings.get("world_model")
    # Settings of the first release were flat, and its world_model was the path of a run.
    return nested.get("seed", 0) if isinstance(nested, dict) else settings.get("world_model_seed", 0)
