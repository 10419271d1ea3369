"""What a run leaves behind: ``eval.json``, the table row beside the paper's, figures, an animation, ``report.html``."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.evaluation.protocol import _rows, result_rows
from dynmap_rl.evaluation.statistics import shared_interval, summarize, summarize_seeds
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import load_policy
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.paper.published import METRICS, paper_numbers
from .html import write_html
from .media import film_policy
from .robot_page import held_out_text, write_held_out
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json

UNITS = {"DR": "%", "PE": "mm", "SR": "%"}


def write_report(
    folder: Path,
    settings,
    dataset,
    world_model: WorldModel,
    episodes: TensorDictBase,
    seeds: list[int],
    frozen: str | None = None,
    source: dict | None = None,
) -> dict:
    """Collect the seeds' results into ``eval.json`` and draw the figures.

    Args:
        folder: run folder with ``seed_N/eval.json`` and ``seed_N/policy``.
        settings: the recipe's dataclass.
        dataset: what was trained on.
        world_model: the frozen one, of which ``frozen`` is the fingerprint, or that of the first seed.
        episodes: held-out demonstrations ``[E, T]``, for the figures.
        seeds: of the policies.
        source: where the world model is from, with its ``task`` and ``training``; by default this very run.

    A dataset of no task has no simulator to act in: see :func:`dynmap_rl.evaluation.write_held_out`.
    """
    from .figures import plot_dynamics, plot_reconstruction

    results = [read_json(folder / f"seed_{seed}" / "eval.json") for seed in seeds]
    if frozen and any(r["world_model_sha256"] != frozen for r in results):
        raise ValueError(f"seeds in {folder} belong to another world model; delete the folder and run again")
    if settings.task == NO_TASK:
        return write_held_out(
            folder, settings, dataset, world_model, episodes, results, seeds, frozen, source
        )
    meta = load_meta(dataset)
    source = source or {"task": settings.task, "training": "decoupled"}
    test = [_rows(r["test"]["rows"]) for r in results]
    result = {
        "row": row_name(world_model.supervision, source["training"]),
        "policy": settings.policy,
        "task": settings.task,
        "trained_on": {"dataset": str(dataset), "kind": meta["kind"], "episodes": meta["splits"]["train"][1]},
        "world_model": source,
        "seeds": list(seeds),
        "world_model_sha256": frozen,
        "paper_protocol": summarize_seeds([_rows(r["paper"]["rows"]) for r in results]),
        "test_protocol": summarize([row for rows in test for row in rows])
        | {"SR_interval": shared_interval(test), "DR_interval": shared_interval(test, "dropped")}
        | _localization(results),
        "settings": {
            k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(settings).items()
        },
        "command": command_line(),
        "results": results,
    }
    world_model.cpu()  # as the episodes are
    if source["training"] != "end_to_end":  # whose decoders are not trained
        plot_reconstruction(world_model, episodes[:3], folder / "figures" / "reconstruction.png")
    plot_dynamics(world_model, episodes[0], folder / "figures" / "dynamics.png")
    policy = load_policy(folder / f"seed_{seeds[0]}" / "policy")
    film_policy(
        Actor(world_model, policy, mixed=True),
        settings.task,
        results[0]["test"]["rows"],
        folder / "rollouts.gif",
    )
    write_html(folder, _title(result), row_text(result), result["command"])
    write_json(folder / "eval.json", result)  # last: it says that all is done
    return result


def _localization(results: list[dict]) -> dict[str, float]:
    """How well the world model finds the cart (mm), over all seeds; rows do not tell it."""
    names = [name for name in results[0]["test"]["summary"] if name.startswith("localization")]
    return {name: float(np.mean([r["test"]["summary"][name] for r in results])) for name in names}


def print_row(result: dict) -> None:
    """The table row, beside the paper's."""
    print(f"\n{row_text(result)}")


def row_text(result: dict) -> str:
    """The same as lines of text."""
    if result["task"] == NO_TASK:
        return held_out_text(result)
    ours, test, paper = result["paper_protocol"], result["test_protocol"], paper_numbers(result)
    low, high = shared_interval(result_rows(result))
    values = "   ".join(f"{name} {test[name]:.1f} {UNITS[name]}" for name in _metrics(result))
    lines = [
        _title(result),
        "  paper's protocol  " + _cells({name: ours[name] for name in _metrics(result)}),
        *(["  paper             " + _cells(paper)] if paper else []),
        f"  {test['episodes']} episodes     {values} [{low:.1f}, {high:.1f}]",
    ]
    return "\n".join(lines)


def markdown_row(result: dict) -> str:
    """A row of the README's tables: the paper's numbers, ours by its protocol, ours on the shared start states, and there
    the SR of each policy."""
    test, paper = result["test_protocol"], paper_numbers(result)
    low, high = shared_interval(result_rows(result))
    others = [f"{test[name]:.1f}" for name in _metrics(result) if name != "SR"]
    ours = _short({name: result["paper_protocol"][name] for name in _metrics(result)})
    rate = f"**{test['SR']:.1f}** [{low:.1f}, {high:.1f}]"
    each = ", ".join(f"{100 * np.mean([row['success'] for row in rows]):.1f}" for rows in result_rows(result))
    return f"| {' | '.join([result['row'], _short(paper) if paper else '-', ours, *others, rate, each])} |"


def _title(result: dict) -> str:
    return f"{_label(result)}, {result['policy']} policy, {result['task']}"


def _label(result: dict) -> str:
    """The row's name, with what its world model is from where that is not the decoupled training on the same task."""
    source = result["world_model"]
    label = f"{result['row']}, joint" if source["training"] == "joint" else result["row"]
    return label if source["task"] == result["task"] else f"{label} of {source['task']}"


def _metrics(result: dict) -> tuple[str, ...]:
    return METRICS.get(result["task"], tuple(UNITS))


def _short(numbers: dict) -> str:
    mean, std = numbers["SR"]
    others = ", ".join(f"{numbers[name][0]:.0f}" for name in numbers if name != "SR")
    return f"{mean:.0f} ({std:.1f})" + (f"; {others}" if others else "")


def _cells(numbers: dict) -> str:
    return "   ".join(f"{name} {mean:.0f} ({std:.1f}) {UNITS[name]}" for name, (mean, std) in numbers.items())
