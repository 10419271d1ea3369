"""Failures by cause: table and figure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dynmap_rl.evaluation.failures import CAUSES, failure_causes
from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.reporting.figures import plt, save_figure
from dynmap_rl.runs.lookup import load_actor
from dynmap_rl.utils.files import read_json

from .cells import TASKS, Key
from .results import Cell
from .tables import cause_table

_DECOUPLED = [
    *(f"{task}_decoupled_{some}_recurrent" for task in TASKS for some in ("none", "position_velocity")),
    *(f"{TASKS[0]}_decoupled_{some}_feedforward" for some in ("none", "position_velocity")),
]
_OTHERS = [
    f"{TASKS[0]}_plain_none_recurrent",
    f"{TASKS[0]}_joint_position_velocity_recurrent",
    f"{TASKS[0]}_end_to_end_recurrent",
]
CELLS = [  # cells whose failures are shown, each with the names of its runs
    *([name, *(f"{name}_world_model_{seed}" for seed in (1, 2))] for name in _DECOUPLED),
    *([name] for name in _OTHERS),
]
REPEATED = "succeeds when repeated"  # frames in other batches differ in their last bits


def find_failures(runs: Sequence[Path]) -> dict:
    """Find the causes of the failed episodes of a cell, those of each run's first policy.

    Where the result does not name them, the episodes are run again.

    Args:
        runs: folders of complete runs of the cell.

    Returns:
        ``task``, ``row``, ``policy``, ``training``, names of the ``runs``, number of ``episodes``, and ``scenes``, the
        scene seeds by cause.
    """
    episodes, scenes = 0, {}
    for run in runs:
        result = read_json(run / "eval.json")
        rows = result_rows(result)[0]
        episodes += len(rows)
        failed = [row for row in rows if not row["success"]]
        seeds, causes = [row["scene_seed"] for row in failed], [row.get("cause") for row in failed]
        if not all(causes):  # an older result
            again = roll_out(load_actor(run, result["seeds"][0]), result["task"], seeds)
            causes = failure_causes(again, result["task"])
        for seed, cause in zip(seeds, causes, strict=True):
            scenes.setdefault(cause or REPEATED, []).append(seed)
    facts = {name: result[name] for name in ("task", "row", "policy")}
    facts |= {"training": result["world_model"]["training"], "runs": [run.name for run in runs]}
    return facts | {"episodes": episodes, "scenes": scenes}


def plot_failures(failures: list[dict], path: Path) -> None:
    """Draw a bar for each cell, the share of failed episodes (%) by cause.

    Args:
        failures: results of :func:`find_failures`.
        path: file to write.
    """
    figure, axis = plt.subplots(figsize=(10, 1.6 + 0.4 * len(failures)), layout="constrained")
    names, left = [f"{_title(one)}, first policy" for one in failures], [0.0] * len(failures)
    colors = plt.get_cmap("tab20").colors
    for number, cause in enumerate(_causes(failures)):
        shares = [_share(one, cause) for one in failures]
        axis.barh(range(len(names)), shares, left=left, color=colors[number], label=cause)
        left = [start + share for start, share in zip(left, shares, strict=True)]
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("failed episodes [%]", fontsize=9)
    axis.set_xlim(0, 1.05 * max([*left, 1.0]))
    if any(left):
        axis.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    save_figure(figure, path)


def markdown_failures(failures: list[dict], cells: Mapping[Key, Cell]) -> str:
    """Return a table of the shares of failed episodes (%) by cause.

    Args:
        failures: results of :func:`find_failures`.
        cells: result of :func:`dynmap_rl.paper.results.read_cells`. Those with failures, except ablations, have a row of
            the results that name causes, over all of their policies.
    """
    lines = [
        (f"{_title(one)}, first policy", one["episodes"], {c: len(s) for c, s in one["scenes"].items()})
        for one in failures
    ]
    for (task, training, policy, row), cell in cells.items():
        if cell.table == "ablations":
            continue
        named = [r for r in cell.results if all("causes" in seed["test"]["rows"] for seed in r["results"])]
        cell = replace(cell, results=tuple(named))
        episodes = [episode for rows in cell.policies for episode in rows]
        if counts := Counter(episode["cause"] for episode in episodes if "cause" in episode):
            training = "end_to_end" if row.startswith("End-to-End") else training
            facts = {
                "task": task,
                "training": training,
                "policy": policy,
                "row": row,
                "runs": cell.world_models,
            }
            lines.append((f"{_title(facts)}, all policies", len(episodes), counts))
    return cause_table(lines)


def _causes(failures: list[dict]) -> list[str]:
    return [cause for cause in (*CAUSES, REPEATED) if any(cause in one["scenes"] for one in failures)]


def _share(one: dict, cause: str) -> float:
    return 100 * len(one["scenes"].get(cause, [])) / one["episodes"]


def _title(one: dict) -> str:
    training = "" if one["training"] == "end_to_end" else f", {one['training']}"
    count = len(one["runs"])
    return f"{one['task']}: {one['row']}{training}, {one['policy']}, {count} world model{'s' * (count > 1)}"
