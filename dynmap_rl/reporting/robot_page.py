"""Result of a run on a robot dataset: errors on held-out episodes, since there is no simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase

from dynmap_rl.data.robot import describe_robot_dataset
from dynmap_rl.evaluation.errors import known_dynamics, naive_errors
from dynmap_rl.evaluation.probing import judged_text
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import find_target
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

from .html import write_html
from .run_page import read_results


def write_robot_report(
    folder: Path,
    world_model: WorldModel,
    episodes: TensorDictBase,
    seeds: Sequence[int],
    *,
    dataset: str | Path,
    camera: str | None,
    goal: str | None,
    policy: str,
    origin: dict[str, str],
    settings: dict,
    command: str,
    frozen: str | None = None,
    judged: dict | None = None,
) -> dict:
    """Collect the results of all seeds, draw a figure, and write ``eval.json`` and ``report.html``.

    Args:
        folder: run folder with ``seed_N/eval.json`` (see :func:`dynmap_rl.evaluation.judge_held_out`).
        world_model: the frozen world model, or that of the first seed.
        episodes: held-out pieces of episodes ``[P, T]``.
        seeds: seeds of the policies.
        dataset: robot dataset, a folder or a hub id.
        camera: camera's column; None is the first camera.
        goal: goal's column and entries, or None.
        policy: kind of the policies, ``feedforward`` or ``recurrent``.
        origin: origin of the world model, with ``dataset`` and ``training`` (decoupled or joint).
        settings: settings of the run, as a nested dict of JSON values.
        command: command that started the run.
        frozen: fingerprint of the frozen world model; None where every seed has a world model of its own.
        judged: result of :func:`dynmap_rl.evaluation.probing.judge_states` on the world model, or None.

    Returns:
        The content of ``eval.json``. ``held_out`` has means over the seeds: ``rgb`` (root mean square, 0 to 1),
        ``imitation_l1`` (normalised) and, in the dataset's units, the mean absolute error of every entry of the action
        and of the supervised dynamics, one step ahead. ``spread`` has the mean absolute error of the best constant, and
        ``change`` that of the value one step earlier. Dynamics that were not found in the frames, and
        actions of disturbed steps, are left out.

    Raises:
        ValueError: a seed was evaluated with another world model.
    """
    from .figures import plot_reconstruction

    results = read_results(folder, seeds, frozen)
    errors = {
        k: float(np.array([r["held_out"][k] for r in results], float).mean()) for k in results[0]["held_out"]
    }
    described = describe_robot_dataset(dataset, camera, goal)
    names, dt = described["names"], 1 / (described["info"].get("fps") or 1)
    names = {key: names[key] for key in (*world_model.supervision, "action")}
    naive = {quantity: naive_errors(_values(episodes, quantity)) for quantity in names}
    result = {
        "row": row_name(world_model.supervision, origin["training"]),
        "policy": policy,
        "trained_on": {
            "dataset": str(dataset),
            "cameras": described["cameras"],
            "fps": described["info"].get("fps"),
            "goal": goal,
            "held_out_episodes": episodes["episode"].unique().tolist(),
            "held_out_pieces": list(episodes.shape),
        },
        "world_model": origin,
        "seeds": list(seeds),
        "world_model_sha256": frozen,
        "judged": judged,
        "held_out": {"rgb": errors["error_rgb"], "imitation_l1": errors["imitation_l1"]}
        | {q: {n: errors[f"error_{q}_{i}"] for i, n in enumerate(own)} for q, own in names.items()},
        "spread": {q: dict(zip(own, naive[q]["constant"], strict=True)) for q, own in names.items()},
        "change": {q: dict(zip(own, naive[q]["earlier"], strict=True)) for q, own in names.items()},
        "settings": settings,
        "command": command,
        "commit": find_commit(),
        "results": results,
    }
    plot_reconstruction(world_model.cpu(), episodes[:3], folder / "figures" / "reconstruction.png", dt=dt)
    title = f"{result['row']}, {policy} policy, {dataset}"
    write_html(folder, title, robot_row_text(result), command, settings)
    write_json(folder / "eval.json", result)  # last: it marks the run as complete
    return result


def robot_row_text(result: dict) -> str:
    """Return the result of :func:`write_robot_report` as lines of text."""
    errors, trained_on = result["held_out"], result["trained_on"]
    held_out = len(trained_on["held_out_episodes"])
    lines = [f"{result['row']}, {result['policy']} policy, {trained_on['dataset']}"]
    if "cameras" in trained_on:  # older results lack them
        lines.append(
            f"  frames of {', '.join(trained_on['cameras'])} at {trained_on['fps']} Hz, goal {trained_on['goal'] or 'none'}"
        )
    lines += [
        f"  held-out errors on {held_out} episodes; there is no simulator, thus no DR, PE or SR",
        f"  rgb {errors['rgb']:.4f} (root mean square)   imitation L1 {errors['imitation_l1']:.4f} (normalised)",
    ]
    for quantity, constant in result["spread"].items():
        simple = [constant, *([result["change"][quantity]] if "change" in result else [])]
        entries = (
            f"{n} {_number(error)} ({', '.join(_number(of[n]) for of in simple)})"
            for n, error in errors[quantity].items()
        )
        lines.append(f"  {quantity:13s} {'   '.join(entries)}")
    if result.get("judged"):
        lines.append(f"  world model: {judged_text(result['judged'])}")
    lines.append(
        "  mean absolute errors in the dataset's units, in brackets those of the best constant and "
        "of the value one step earlier"
    )
    return "\n".join(lines)


def _number(error: float | None) -> str:
    """Return an error as text; one that no held-out step tells is NaN, and None in a file."""
    return "not known" if error is None or math.isnan(error) else f"{error:.3g}"


def _values(episodes: TensorDictBase, quantity: str) -> torch.Tensor:
    if quantity != "action":
        return known_dynamics(episodes, quantity)
    action, ignore = find_target(episodes)
    return action if ignore is None else action.where(~ignore, torch.nan)
