"""What a run leaves behind: ``eval.json``, the table row beside the paper's, figures, an animation, ``report.html``."""

from __future__ import annotations

from tensordict.nn import TensorDictModuleBase

from .rollout import episode_rows, roll_out, scene_seeds
from .statistics import summarize

SHARED_STARTS = 1000  # the paper's protocol uses the scenes after these


def evaluate(
    actor: TensorDictModuleBase,
    task: str,
    test_episodes: int = 1000,
    paper_episodes: int = 50,
    split: str = "test",
) -> dict[str, dict]:
    """One actor (see :func:`roll_out`) by both protocols: rows and summary on ``test_episodes`` shared start states
    (``test``) and on ``paper_episodes`` others (``paper``, where there are any) of a split of the scenes. All episodes
    run as one batch.

    Raises:
        ValueError: more than 1,000 shared start states, which are all there are.
    """
    if test_episodes > SHARED_STARTS:
        raise ValueError(f"there are {SHARED_STARTS} shared start states, not {test_episodes}")
    seeds = scene_seeds(split, test_episodes)
    seeds += scene_seeds(split, paper_episodes, start=SHARED_STARTS)
    rows = episode_rows(roll_out(actor, task, seeds), seeds)
    parts = {"test": rows[:test_episodes], "paper": rows[test_episodes:]}
    return {
        name: {"summary": summarize(part), "rows": _columns(part)} for name, part in parts.items() if part
    }


def result_rows(result: dict) -> list[list[dict]]:
    """The rows on the shared start states of every policy seed of an ``eval.json``."""
    return [_rows(seed["test"]["rows"]) for seed in result["results"]]


FLAGS = "success", "dropped", "touched"


def _columns(rows: list[dict]) -> dict:
    """Rows of scenes in a row, as short as they can be told: flags as text of 0 and 1, and the first scene's seed."""
    columns = {flag: "".join(str(int(row[flag])) for row in rows) for flag in FLAGS}
    errors = [round(row["position_error"], 4) for row in rows]
    return {"first_scene_seed": rows[0]["scene_seed"], **columns, "position_error": errors}


def _rows(columns: dict) -> list[dict]:
    flags = [[flag == "1" for flag in columns[name]] for name in FLAGS]
    values = zip(*flags, columns["position_error"], strict=True)
    names = "scene_seed", *FLAGS, "position_error"
    first = columns["first_scene_seed"]
    return [dict(zip(names, (first + i, *row), strict=True)) for i, row in enumerate(values)]
