"""Results of the grid of sources: cheap measures of world models, and tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from scipy.stats import PermutationMethod, pearsonr, rankdata
from tensordict import TensorDictBase

from dynmap_rl.evaluation.probing import judge_states, probe
from dynmap_rl.evaluation.protocol import result_rows
from dynmap_rl.evaluation.statistics import shared_interval, summarize
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.utils.files import read_json

from .results import read_on_same_scenes
from .sources import DATA_ROWS, POLICIES, SIZES, SOURCES, WORLD_MODELS, dataset_folder, name_run
from .tables import gap_text, join_table

CONTEXT, HORIZON = 20, 40  # steps with frames, and then without
FEWEST = 5  # sources of a rank correlation
MEASURES = {  # name: text, and the sign with which it should rise with success
    "probe_position": ("R^2 of a linear map to the positions (x, y and angles)", 1),
    "probe_velocity": ("R^2 of a linear map to the velocities (x, y and angles)", 1),
    "open_loop_mm": ("error after 2 s without frames (mm)", -1),
}


@torch.no_grad()
def measure_world_model(model: WorldModel, train: TensorDictBase, test: TensorDictBase) -> dict[str, float]:
    """Measure a world model without a policy or a simulator, by linear maps to the true dynamics.

    World models without supervision and with other entries are measured alike.

    Args:
        model: frozen world model.
        train: demonstrations ``[E, T]`` with true dynamics, to fit the maps to.
        test: held-out ones.

    Returns:
        ``probe_position`` and ``probe_velocity``, R^2 of the best state (latent or a hidden one), the mean over the
        entries; ``open_loop_mm``, the mean distance of predicted and true positions of cart and block (mm) after two
        seconds without frames.
    """
    found = probe(model, train, test)
    result = {
        "probe_position": max(float(np.nanmean(states["position"])) for states in found.values()),
        "probe_velocity": judge_states(found)["r2"],
    }
    x, y = _predictions(model, train), train["dynamics", "position"]
    mean, center = x.flatten(0, 1).mean(0), y[:, 1:].flatten(0, 1).double().mean(0)
    weights = torch.linalg.lstsq(
        x.flatten(0, 1) - mean, y[:, 1:].flatten(0, 1).double() - center, driver="gelsd"
    ).solution
    last = CONTEXT + HORIZON - 1
    predicted = (_predictions(model, test, CONTEXT)[:, last - 1] - mean) @ weights + center
    error = (predicted - test["dynamics", "position"][:, last].double()).unflatten(-1, (-1, 3))[..., :2]
    return result | {"open_loop_mm": 1000 * error.norm(dim=-1).mean().item()}


def _predictions(model: WorldModel, episodes: TensorDictBase, context: int | None = None) -> torch.Tensor:
    """Return predicted latents and hidden states ``[E, T - 1, F]`` from t = 1 on, without frames after ``context``."""
    parts = []
    for chunk in episodes.split(10):
        chunk = chunk.to(next(model.parameters()).device)
        latent = model.encode(chunk["pixels"], mixed=True).float()
        states = (
            model.predict(latent, chunk["action"])
            if context is None
            else model.transition.imagine(latent, chunk["action"], context)
        )
        parts.append(torch.cat(states, -1)[:, 1:].double().cpu())
    return torch.cat(parts)


def read_source(results: Path, task: str, source: str, policy: str, size: int = 300) -> dict | None:
    """Read the results of all world models of a source.

    Returns:
        ``SR``, ``DR`` (%), ``PE`` (mm), the 95 % ``interval`` of SR over world models and policy seeds on the shared
        start states, the SR of each of the ``world_models``, their number, and the mean of each of the ``measures``;
        None without a result.
    """
    names = [name_run(task, source, seed, policy, size) for seed in WORLD_MODELS]
    names = names[:1] if source == "end_to_end" else names
    found = read_on_same_scenes(results / f"{name}.json" for name in names)
    if not found:
        return None
    by_model = [result_rows(result) for result in found]
    if source == "end_to_end":  # each of its policies has a world model of its own
        by_model = [[of_seed] for of_seed in by_model[0]]
    rows = [of_seed for model in by_model for of_seed in model]
    everything = summarize([row for of_seed in rows for row in of_seed])
    measured = [
        read_json(path)
        for seed in WORLD_MODELS
        if (path := results / "measures" / f"{name_run(task, source, seed, 'recurrent', size)}.json").exists()
    ]
    return {
        **{name: everything[name] for name in ("SR", "DR", "PE")},
        "interval": shared_interval(rows),
        "world_models": [summarize([r for seed in model for r in seed])["SR"] for model in by_model],
        "measures": {name: float(np.mean([m[name] for m in measured])) for name in MEASURES if measured},
        "commands": [result["command"] for result in found],
    }


def source_table(results: Path, task: str) -> str:
    """Return the table of a task in Markdown: SR of both policies, share of the gain, cheap measures, and quality."""
    found = {(s, p): read_source(results, task, s, p) for s in SOURCES for p in POLICIES}
    lines = []
    for name, source in SOURCES.items():
        if not any(found[name, policy] for policy in POLICIES):
            continue
        line = [source.text]
        for policy in POLICIES:
            line += _rate(found[name, policy], found["none", policy], found["simulator", policy])
        measures = (found[name, "recurrent"] or {}).get("measures") or {}
        line += [f"{measures[m]:.3g}" if m in measures else "" for m in MEASURES]
        lines.append([*line, _verdict(results, task, name)])
    head = ["dynamics"]
    for policy in POLICIES:
        head += [f"SR, {policy}", "of each world model", "share of the gain"]
    return join_table([*head, *(text for text, _ in MEASURES.values()), "derived columns"], lines)


def _verdict(results: Path, task: str, source: str) -> str:
    """Return the verdict on the derived columns of a source, with the checks that failed; "" if it has none."""
    path = results / "quality" / f"{dataset_folder(task, source, Path()).name}.json"
    if SOURCES[source].columns is None or not path.exists():
        return ""
    quality = read_json(path)
    failed = ", ".join(name for name, check in quality["checks"].items() if not check["good"])
    return f"{quality['verdict']} ({failed})" if failed else quality["verdict"]


def _rate(cell: dict | None, none: dict | None, full: dict | None) -> list[str]:
    if not cell:
        return ["", "", ""]
    low, high = cell["interval"]
    gain = full["SR"] - none["SR"] if none and full else 0.0
    share = f"{100 * (cell['SR'] - none['SR']) / gain:.0f} %" if gain > 0 else ""
    each = ", ".join(f"{rate:.1f}" for rate in cell["world_models"])
    return [f"**{cell['SR']:.1f}** [{low:.1f}, {high:.1f}]", each, share]


def gap_table(results: Path, task: str) -> str:
    """Return how many points of SR a source has more or less than the simulator's dynamics, in Markdown.

    The 95 % intervals (Welch's t) are over world models and are left out where there are too few.
    """
    lines, full = [], {policy: read_source(results, task, "simulator", policy) for policy in POLICIES}
    for name, source in SOURCES.items():
        gaps = []
        for policy in POLICIES:
            both = full[policy] and name != "simulator" and (cell := read_source(results, task, name, policy))
            gaps.append(gap_text(cell["world_models"], full[policy]["world_models"]) if both else "")
        if any(gaps):
            lines.append([source.text, *gaps])
    return join_table(["points of SR more than with the simulator's dynamics", *POLICIES], lines)


def data_table(results: Path, task: str) -> str:
    """Return SR against the number of demonstrations in Markdown, recurrent policies; also of each of several world models."""
    lines = []
    for name, text in DATA_ROWS.items():
        cells = [read_source(results, task, name, "recurrent", size) for size in SIZES]
        if any(cells):
            rates = [_rate(cell, None, None) for cell in cells]
            lines.append([text, *(f"{rate} ({each})" if "," in each else rate for rate, each, _ in rates)])
    return join_table(["", *map(str, SIZES)], lines)


def rank_correlations(results: Path, task: str) -> dict[tuple[str, str], dict[str, float]]:
    """Return Spearman's rank correlation of each measure with SR, by policy, with its p and the number of sources.

    p is that of random pairings. There is no correlation of less than five sources.
    """
    correlations = {}
    for policy in POLICIES:
        _, rates, measures = measured_points(results, task, policy)
        for name, values in measures.items() if len(rates) >= FEWEST else ():
            random = PermutationMethod(rng=np.random.default_rng(0))
            found = pearsonr(rankdata(values), rankdata(rates), method=random)
            numbers = {"rho": float(found.statistic), "p": float(found.pvalue), "sources": len(rates)}
            correlations[policy, name] = numbers
    return correlations


def measured_points(results: Path, task: str, policy: str) -> tuple[list, list, dict[str, list]]:
    """Return name, SR and measures of every source, means over the world models that have both."""
    names, points = [], []
    for source in SOURCES:
        pairs = []
        for seed in WORLD_MODELS:
            path = results / f"{name_run(task, source, seed, policy)}.json"
            measured = results / "measures" / f"{name_run(task, source, seed, 'recurrent')}.json"
            if path.exists() and measured.exists() and not _is_unmeasured(path):
                rows = [row for of_seed in result_rows(read_json(path)) for row in of_seed]
                found = read_json(measured)
                pairs.append([summarize(rows)["SR"], *(found[name] for name in MEASURES)])
        if pairs:
            names.append(source)
            points.append(np.mean(pairs, 0).tolist())
    rates, *values = map(list, zip(*points, strict=True)) if points else [[]] * (1 + len(MEASURES))
    return names, rates, dict(zip(MEASURES, values, strict=True))


def find_unmeasured(results: Path) -> list[str]:
    """Return the runs whose frozen world model is not the one that was measured under its name.

    That is so where a world model was trained again, between its recurrent and its feed-forward policies. Measures that
    name no world model are of the recurrent policies' one.
    """
    return [path.stem for path in sorted(results.glob("*_world_model_*.json")) if _is_unmeasured(path)]


def _is_unmeasured(path: Path) -> bool:
    name = f"{path.stem.rpartition('_')[0]}_recurrent.json"
    owners = [read_json(p) for p in (path.parent / "measures" / name, path.parent / name) if p.exists()]
    owner = next((o["world_model_sha256"] for o in owners if o.get("world_model_sha256")), None)
    return owner not in (None, read_json(path).get("world_model_sha256"))
