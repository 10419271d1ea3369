"""Result of a run in closed loop: ``eval.json``, figures, an animation and ``report.html``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase

from dynmap_rl.data.demonstrations import find_layout, find_meta
from dynmap_rl.data.format.reading import find_dataset
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.evaluation.protocol import result_rows, unpack_rows
from dynmap_rl.evaluation.statistics import causes_text, shared_interval, summarize, summarize_seeds
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import load_policy
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.utils.devices import device_name
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

from .html import write_html
from .media import film_policy

UNITS = {"DR": "%", "PE": "mm", "SR": "%"}

Numbers = dict[str, tuple[float, float]]  # metric to mean and standard deviation


def write_report(
    folder: Path,
    world_model: WorldModel,
    episodes: TensorDictBase,
    seeds: Sequence[int],
    *,
    task: str,
    dataset: str | Path,
    policy: str,
    origin: dict[str, str],
    settings: dict,
    command: str,
    frozen: str | None = None,
    compare: Callable[[dict], Numbers | None] | None = None,
) -> dict:
    """Collect the results of all seeds, draw figures and an animation, and write ``eval.json`` and ``report.html``.

    Args:
        folder: run folder with ``seed_N/eval.json`` and ``seed_N/policy``.
        world_model: the frozen world model, or that of the first seed.
        episodes: held-out demonstrations ``[E, T]``, for the figures.
        seeds: seeds of the policies.
        task: name of the task of the policies.
        dataset: demonstrations that the policies were trained on, a folder or a hub id.
        policy: kind of the policies, ``feedforward`` or ``recurrent``.
        origin: origin of the world model, with ``task`` and ``training`` (decoupled, joint or end_to_end).
        settings: settings of the run, as a nested dict of JSON values; ``compute.device`` is its device.
        command: command that started the run.
        frozen: fingerprint of the frozen world model; None where every seed has a world model of its own.
        compare: function from the result to published numbers for the same row (see :func:`row_text`), or to None.

    Returns:
        The content of ``eval.json``.

    Raises:
        ValueError: a seed was evaluated with another world model.
    """
    results = read_results(folder, seeds, frozen)
    test = [unpack_rows(r["test"]["rows"]) for r in results]
    result = {
        "row": row_name(world_model.supervision, origin["training"]),
        "policy": policy,
        "task": task,
        "trained_on": _describe(dataset),
        "world_model": origin,
        "seeds": list(seeds),
        "world_model_sha256": frozen,
        **_paper_protocol(results),
        "test_protocol": summarize([row for rows in test for row in rows])
        | {"SR_interval": shared_interval(test), "DR_interval": shared_interval(test, "dropped")}
        | (_localization(results) if _has_entries_of_its_task(dataset, task) else {}),
        "settings": settings,
        "command": command,
        "commit": find_commit(),
        "device": device_name(settings.get("compute", {}).get("device", "auto")),
        "results": [
            one | {"losses": _policy_losses(folder / f"seed_{seed}")}
            for one, seed in zip(results, seeds, strict=True)
        ],
    }
    _draw(folder, world_model, episodes, result)
    published = compare(result) if compare else None
    write_html(folder, _title(result), row_text(result, published), command, settings)
    write_json(folder / "eval.json", result)  # last: it marks the run as complete
    return result


def read_results(folder: Path, seeds: Sequence[int], frozen: str | None) -> list[dict]:
    """Read ``seed_N/eval.json`` of every seed.

    Args:
        folder: run folder.
        seeds: seeds of the policies.
        frozen: fingerprint that every result must have, or None.

    Raises:
        ValueError: a result has another fingerprint.
    """
    results = [read_json(folder / f"seed_{seed}" / "eval.json") for seed in seeds]
    if frozen and any(result["world_model_sha256"] != frozen for result in results):
        raise ValueError(f"seeds in {folder} belong to another world model; delete the folder and run again")
    return results


def _describe(dataset: str | Path) -> dict:
    """Return name, kind and number of training episodes; a dataset edited by other tools has only a name."""
    meta = find_meta(find_dataset(dataset))
    facts = {"kind": meta["kind"], "episodes": meta["splits"]["train"][1]} if meta else {}
    return {"dataset": str(dataset)} | facts


def _policy_losses(folder: Path) -> dict[str, list[float]]:
    """Return the policy's losses by optimiser step: plain L1 held out, and that of a training batch, with emphasis."""
    rows = [row for row in read_metrics(folder) if "held_out_loss" in row]
    training = [
        row["loss_policy"] if "loss_policy" in row else row["loss"] for row in rows
    ]  # joint, decoupled
    held_out = [row["held_out_loss"] for row in rows]
    return {"step": [row["step"] for row in rows], "held_out": held_out, "training": training}


def _paper_protocol(results: list[dict]) -> dict:
    """Return the summary by the paper's protocol, unless no episode was run by it."""
    if any("paper" not in result for result in results):
        return {}
    return {"paper_protocol": summarize_seeds([unpack_rows(r["paper"]["rows"]) for r in results])}


def _has_entries_of_its_task(dataset: str | Path, task: str) -> bool:
    """Return whether the positions of a dataset are those that the task measures; tracks may be of others, in pixels."""
    return find_layout(find_meta(find_dataset(dataset))).position == get_task(task).layout.position


def _localization(results: list[dict]) -> dict[str, float]:
    """Return the mean over the seeds of the error in the first body's position (mm), where it is predicted."""
    summaries = [result["test"]["summary"] for result in results]
    errors = [summary["localization"] for summary in summaries if "localization" in summary]
    return {"localization": float(np.mean(errors))} if errors else {}


def _draw(folder: Path, world_model: WorldModel, episodes: TensorDictBase, result: dict) -> None:
    from .figures import plot_dynamics, plot_reconstruction

    world_model.cpu()  # as the episodes are
    dataset = result["trained_on"]["dataset"]
    layout, units = (
        find_layout(find_meta(find_dataset(dataset))),
        _has_entries_of_its_task(dataset, result["task"]),
    )
    if result["world_model"]["training"] != "end_to_end":  # its decoders are not trained
        path = folder / "figures" / "reconstruction.png"
        plot_reconstruction(world_model, episodes[:3], path, dt=layout.dt)
    plot_dynamics(world_model, episodes[0], folder / "figures" / "dynamics.png", layout, units=units)
    policy = load_policy(folder / f"seed_{result['seeds'][0]}" / "policy")
    actor, rows = Actor(world_model, policy, mixed=True), result["results"][0]["test"]["rows"]
    film_policy(actor, result["task"], rows, folder / "rollouts.gif")


def row_text(result: dict, published: Numbers | None = None) -> str:
    """Return the row of a result as lines of text.

    Args:
        result: an ``eval.json``.
        published: mean and standard deviation of each published metric of the same row, for comparison. Only these
            metrics are shown.
    """
    test, names = result["test_protocol"], list(published or UNITS)
    low, high = shared_interval(result_rows(result))
    values = "   ".join(f"{name} {test[name]:.1f} {UNITS[name]}" for name in names)
    lines = [_title(result)]
    if ours := result.get("paper_protocol"):
        lines.append("  paper's protocol  " + _cells({name: ours[name] for name in names}))
    if published:
        lines.append("  paper             " + _cells(published))
    lines.append(f"  {test['episodes']} episodes     {values} [{low:.1f}, {high:.1f}]")
    if failures := causes_text(test):
        lines.append(f"  {failures}")
    return "\n".join(lines)


def _title(result: dict) -> str:
    return f"{_label(result)}, {result['policy']} policy, {result['task']}"


def _label(result: dict) -> str:
    """Return the row's name, and the origin of its world model unless that is decoupled training on the same task."""
    origin = result["world_model"]
    label = f"{result['row']}, joint" if origin["training"] == "joint" else result["row"]
    return label if origin["task"] == result["task"] else f"{label} of {origin['task']}"


def _cells(numbers: Numbers) -> str:
    return "   ".join(f"{name} {mean:.0f} ({std:.1f}) {UNITS[name]}" for name, (mean, std) in numbers.items())
