"""World model and policy trained as one, what joint and end-to-end training share (paper, Sec. III-B)."""

from __future__ import annotations

from pathlib import Path

import torch

from dynmap_rl import data, modules, runs
from dynmap_rl.envs.tasks import NO_TASK
from dynmap_rl.evaluation import evaluate, policy_errors
from dynmap_rl.settings import load_episodes
from dynmap_rl.training import prediction_errors, train_jointly
from dynmap_rl.weights import fingerprint


def train_seeds(
    dataset: str | Path,
    supervision: tuple[str, ...],
    folder: Path,
    settings,
    seeds: list[int],
    end_to_end: bool = False,
) -> None:
    """Train and judge a world model with its policy for every seed that ``folder`` does not hold yet.

    Args:
        dataset: a folder or a hub id.
        supervision: of the world model.
        folder: run folder; gets ``seed_N`` with ``world_model``, ``policy``, ``metrics.jsonl``, ``eval.json``.
        settings: see :func:`dynmap_rl.training.train_jointly`; also with ``policy``, ``device``, ``split``,
            ``test_episodes`` and ``paper_episodes``.
        seeds: of world model and policy.
        end_to_end: minimise the policy's loss alone.

    Raises:
        OSError: a process died.
    """
    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    arguments = [(dataset, supervision, folder, settings, seed, end_to_end) for seed in todo]
    runs.run_processes([_train_and_evaluate], arguments, settings.threads)


def _train_and_evaluate(arguments: tuple) -> None:
    dataset, supervision, folder, settings, seed, end_to_end = arguments
    torch.set_num_threads(1)
    runs.seed_everything(2000 + seed)
    episodes, constants = load_episodes(settings, dataset)
    device = runs.choose_device(settings.device)
    world_model = modules.make_world_model(constants, supervision).to(device)
    policy = modules.make_policy(constants, settings.policy, world_model).to(device)
    folder = folder / f"seed_{seed}"
    train_jointly(world_model, policy, episodes, folder, settings, seed, end_to_end)
    world_model.eval(), policy.eval()
    modules.save_world_model(folder / "world_model", world_model)
    modules.save_policy(folder / "policy", policy, world_model)
    if settings.task == NO_TASK:
        features = data.compute_features(world_model, episodes["eval"])
        errors = prediction_errors(world_model, episodes["eval"], by_entry=True)
        result = {"held_out": errors | policy_errors(policy, features)}
    else:
        sizes = settings.test_episodes, settings.paper_episodes
        result = evaluate(
            modules.Actor(world_model, policy, mixed=True), settings.task, *sizes, settings.split
        )
    runs.write_json(folder / "eval.json", result | {"world_model_sha256": fingerprint(world_model)})
