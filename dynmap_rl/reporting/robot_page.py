"""The result of a run on a dataset that no simulator belongs to: held-out errors in the place of DR, PE and SR."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from tensordict import TensorDictBase

from dynmap_rl.data.robot import describe_foreign
from dynmap_rl.evaluation.errors import prediction_errors
from dynmap_rl.modules.supervision import row_name
from dynmap_rl.modules.world_model import WorldModel
from .html import write_html
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json


def write_held_out(
    folder: Path,
    settings,
    dataset,
    world_model: WorldModel,
    episodes: TensorDictBase,
    results: list[dict],
    seeds: list[int],
    frozen: str | None = None,
    source: dict | None = None,
) -> dict:
    """Collect the ``results`` of the seeds into ``eval.json``; for the other arguments see ``write_report``.

    ``held_out`` has ``rgb`` (root mean square, 0..1), ``imitation_l1`` (normalised) and, in the dataset's units, the
    mean absolute error of every entry of the supervised dynamics, one step ahead, and of the action: means over the
    seeds. ``spread`` has that of the best constant, which knows the held-out pieces but no frame.
    """
    from .figures import plot_reconstruction

    errors = {k: float(np.mean([r["held_out"][k] for r in results])) for k in results[0]["held_out"]}
    if frozen:  # one world model for all seeds, which have not judged it
        world_model.cpu()  # as the episodes are
        errors |= prediction_errors(world_model, episodes, by_entry=True)
    names = describe_foreign(dataset, settings.camera, settings.goal)["names"]
    names = {key: names[key] for key in (*world_model.supervision, "action")}
    training = {"task": settings.task, "training": "decoupled", "dataset": str(dataset)}
    result = {
        "row": row_name(world_model.supervision, (source or training)["training"]),
        "policy": settings.policy,
        "task": settings.task,
        "trained_on": {
            "dataset": str(dataset),
            "held_out_episodes": episodes["episode"].unique().tolist(),
            "held_out_pieces": list(episodes.shape),
        },
        "world_model": source or training,
        "seeds": list(seeds),
        "world_model_sha256": frozen,
        "held_out": {"rgb": errors["error_rgb"], "imitation_l1": errors["imitation_l1"]}
        | {q: {n: errors[f"error_{q}_{i}"] for i, n in enumerate(own)} for q, own in names.items()},
        "spread": {q: dict(zip(own, _spread(episodes, q), strict=True)) for q, own in names.items()},
        "settings": {
            k: str(v) if isinstance(v, Path) else v for k, v in dataclasses.asdict(settings).items()
        },
        "command": command_line(),
        "results": results,
    }
    path = folder / "figures" / "reconstruction.png"
    plot_reconstruction(world_model.cpu(), episodes[:3], path)
    title = f"{result['row']}, {settings.policy} policy, {dataset}"
    write_html(folder, title, held_out_text(result), result["command"])
    write_json(folder / "eval.json", result)  # last: it says that all is done
    return result


def held_out_text(result: dict) -> str:
    """The row of a dataset without a simulator, as lines of text."""
    errors, trained_on = result["held_out"], result["trained_on"]
    held_out = len(trained_on["held_out_episodes"])
    lines = [
        f"{result['row']}, {result['policy']} policy, {trained_on['dataset']}",
        f"  held-out errors on {held_out} episodes; without a simulator there is no closed loop, no DR, PE or SR",
        f"  rgb {errors['rgb']:.4f} (root mean square)   imitation L1 {errors['imitation_l1']:.4f} (normalised)",
    ]
    for quantity, constant in result["spread"].items():
        entries = (f"{n} {error:.3g} ({constant[n]:.3g})" for n, error in errors[quantity].items())
        lines.append(f"  {quantity:13s} {'   '.join(entries)}")
    lines.append("  mean absolute errors in the dataset's units, in brackets those of the best constant")
    return "\n".join(lines)


def _spread(episodes: TensorDictBase, quantity: str) -> list[float]:
    values = episodes["action" if quantity == "action" else ("dynamics", quantity)].flatten(0, 1)
    return (values - values.median(0).values).abs().mean(0).tolist()
