"""What a run leaves behind: ``eval.json``, the table row beside the paper's, figures and an animation."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tensordict import TensorDictBase

from dynmap_rl.data import load_meta
from dynmap_rl.envs import scene_seed
from dynmap_rl.modules import Actor, WorldModel, load_policy
from dynmap_rl.runs import command_line, read_json, write_json

from .paper import METRICS, paper_numbers, row_name
from .rollout import episode_rows, roll_out, scene_seeds
from .statistics import summarize, summarize_seeds

UNITS = {"DR": "%", "PE": "mm", "SR": "%"}
SHARED_STARTS = 1000  # the paper's protocol uses the scenes after these


def evaluate(
    world_model: WorldModel,
    policy,
    task: str,
    test_episodes: int = 1000,
    paper_episodes: int = 50,
    split: str = "test",
) -> dict[str, dict]:
    """One policy by both protocols: rows and summary on ``test_episodes`` shared start states (``test``) and on
    ``paper_episodes`` others (``paper``) of a split of the scenes. All episodes run as one batch.

    Raises:
        ValueError: more than 1,000 shared start states, which are all there are.
    """
    if test_episodes > SHARED_STARTS:
        raise ValueError(f"there are {SHARED_STARTS} shared start states, not {test_episodes}")
    seeds = scene_seeds(split, test_episodes)
    seeds += scene_seeds(split, paper_episodes, start=SHARED_STARTS)
    rows = episode_rows(roll_out(Actor(world_model, policy), task, seeds), seeds)
    parts = {"test": rows[:test_episodes], "paper": rows[test_episodes:]}
    return {name: {"summary": summarize(part), "rows": _columns(part)} for name, part in parts.items()}


def write_report(
    folder: Path,
    settings,
    dataset,
    world_model,
    episodes: TensorDictBase,
    seeds,
    frozen,
    source: dict | None = None,
) -> dict:
    """Collect the seeds' results into ``eval.json`` and draw the figures.

    Args:
        folder: run folder with ``seed_N/eval.json`` and ``seed_N/policy``.
        settings: the recipe's dataclass.
        dataset: what was trained on.
        world_model: the frozen one; ``frozen`` is its fingerprint.
        episodes: held-out demonstrations ``[E, T]``, for the figures.
        seeds: of the policies.
        source: where the world model is from, with its ``task`` and ``training``; by default this very run.
    """
    from .figures import plot_dynamics, plot_reconstruction, save_gif

    meta = load_meta(dataset)
    results = [read_json(folder / f"seed_{seed}" / "eval.json") for seed in seeds]
    if any(r["world_model_sha256"] != frozen for r in results):
        raise ValueError(f"seeds in {folder} belong to another world model; delete the folder and run again")
    test = [_rows(r["test"]["rows"]) for r in results]
    result = {
        "row": row_name(world_model.supervision),
        "policy": settings.policy,
        "task": settings.task,
        "trained_on": {"dataset": str(dataset), "kind": meta["kind"], "episodes": meta["splits"]["train"][1]},
        "world_model": source or {"task": settings.task, "training": "decoupled"},
        "seeds": list(seeds),
        "world_model_sha256": frozen,
        "paper_protocol": summarize_seeds([_rows(r["paper"]["rows"]) for r in results]),
        "test_protocol": summarize([row for rows in test for row in rows]),
        "settings": {
            k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(settings).items()
        },
        "command": command_line(),
        "results": results,
    }
    plot_reconstruction(world_model, episodes[:3], folder / "figures" / "reconstruction.png")
    plot_dynamics(world_model, episodes[0], folder / "figures" / "dynamics.png")
    policy = load_policy(folder / f"seed_{seeds[0]}" / "policy")
    some = [scene_seed("validation", i) for i in range(8)]
    rollouts = roll_out(Actor(world_model, policy), settings.task, some, keep_pixels=True)
    save_gif(rollouts, folder / "rollouts.gif")
    write_json(folder / "eval.json", result)
    return result


def read_rows(path: Path) -> list[list[dict]]:
    """The rows on the shared start states of every policy seed of an ``eval.json``."""
    return [_rows(result["test"]["rows"]) for result in read_json(path)["results"]]


def print_row(result: dict) -> None:
    """The table row, beside the paper's."""
    ours, test, paper = result["paper_protocol"], result["test_protocol"], paper_numbers(result)
    low, high = test["SR_interval"]
    print(f"\n{_label(result)}, {result['policy']} policy, {result['task']}")
    print("  paper's protocol  " + _cells({name: ours[name] for name in _metrics(result)}))
    if paper:
        print("  paper             " + _cells(paper))
    values = "   ".join(f"{name} {test[name]:.1f} {UNITS[name]}" for name in _metrics(result))
    print(f"  {test['episodes']} episodes     {values} [{low:.1f}, {high:.1f}]")


def markdown_row(result: dict) -> str:
    """The row of the README's table: the paper's numbers, ours by its protocol, ours on the shared start states."""
    ours, test, paper = result["paper_protocol"], result["test_protocol"], paper_numbers(result)
    low, high = test["SR_interval"]
    metrics = _metrics(result)
    cells = [
        f"{_label(result)}, {result['policy']}",
        _short(paper) if paper else "-",
        _short({name: ours[name] for name in metrics}),
        *(f"{test[name]:.1f}" for name in metrics if name != "SR"),
        f"**{test['SR']:.1f}** [{low:.1f}, {high:.1f}]",
    ]
    return f"| {' | '.join(cells)} |"


def _label(result: dict) -> str:
    """The row's name, with the world model's task where it is another."""
    source = result.get("world_model", result)["task"]
    return result["row"] if source == result["task"] else f"{result['row']} of {source}"


def _metrics(result: dict) -> tuple[str, ...]:
    return METRICS.get(result["task"], tuple(UNITS))


def _short(numbers: dict) -> str:
    mean, std = numbers["SR"]
    others = ", ".join(f"{numbers[name][0]:.0f}" for name in numbers if name != "SR")
    return f"{mean:.0f} ({std:.1f})" + (f"; {others}" if others else "")


def _cells(numbers: dict) -> str:
    return "   ".join(f"{name} {mean:.0f} ({std:.1f}) {UNITS[name]}" for name, (mean, std) in numbers.items())


def _columns(rows: list[dict]) -> dict[str, list]:
    return {key: [row[key] for row in rows] for key in rows[0]}


def _rows(columns: dict[str, list]) -> list[dict]:
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
