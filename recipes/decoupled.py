"""Decoupled training (paper, Sec. III-B): train a world model, freeze it, train policies on its states, evaluate.

    python recipes/decoupled.py                                       # RGB+[P+V], recurrent policy
    python recipes/decoupled.py --world_model.supervision none --policy.kind feedforward
    python recipes/decoupled.py --task bin_dropping
    python recipes/decoupled.py --task mujoco:FetchSlide --eval.episodes 500 --eval.paper_episodes 0

Demonstrations are recorded with the shipped expert where they are missing. The same command resumes a stopped run, and
prints the result of a finished one.
"""

import sys
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.training.settings import PolicyTraining, WorldModelTraining
from dynmap_rl.utils.cli import command_line, parse_seeds, refuse, run_recipe
from dynmap_rl.utils.devices import RankedCompute
from dynmap_rl.utils.ray_train import train_by_ray


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, mujoco:FetchPush (FetchSlide, PlateSlide, Soccer),
    # or module:Class of your own.
    task: str = "balance_reaching"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded where it is missing.
    dataset: str | None = None
    # Folder for decoded datasets; by default DATASET.cache beside the dataset.
    cache: Path | None = None
    # Run folder; by default runs/decoupled/TASK/SUPERVISION_KIND.
    run: Path | None = None
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # Run whose world model is used instead of training one: a folder, a hub id, or balance_reaching (shipped).
    pretrained: str | None = None
    # World model.
    world_model: WorldModelTraining = WorldModelTraining()
    # Policies.
    policy: PolicyTraining = PolicyTraining()
    # Evaluation in closed loop.
    eval: Evaluation = Evaluation()
    # Device, cores and processes.
    compute: RankedCompute = RankedCompute()
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None


def main(config: Config) -> None:
    """Train, evaluate and report."""
    if config.compute.launcher == "ray":
        return train_by_ray(main, config, sys.argv)
    import torch

    from dynmap_rl.data.demonstrations import load_demonstrations
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.protocol import judge_in_closed_loop
    from dynmap_rl.paper.published import paper_numbers
    from dynmap_rl.reporting.run_page import row_text, write_report
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.training.dagger import check_corrections
    from dynmap_rl.training.dataset import check_dataset, choose_augmentation, find_or_record
    from dynmap_rl.training.decoupled import check_copies, check_same, train_policies
    from dynmap_rl.training.settings import check_window_steps
    from dynmap_rl.training.world_model import build_world_model, train_world_model
    from dynmap_rl.utils.devices import choose_device, seed_everything
    from dynmap_rl.utils.files import read_json
    from dynmap_rl.utils.ranks import first_rank_first, join_ranks, leave_ranks

    join_ranks(config.compute.device)
    task, seeds = get_task(config.task), parse_seeds(config.seeds)
    device = choose_device(config.compute.device)
    check_logger(config.logger)
    check_corrections(config.policy, config.task, seeds)
    check_copies(config.policy, config.task)
    if config.dataset:
        check_dataset(config.dataset, config.task)
    augmentation = choose_augmentation(task, config.world_model.augmentation)
    world_model = load_pretrained(config) if config.pretrained else None
    if world_model is None:
        check_window_steps(config.world_model, task.layout.steps, "world_model")
    origin = {"task": config.task, "training": "decoupled"}
    name = f"{config.world_model.supervision.replace(',', '_')}_{config.policy.kind}"
    folder = config.run or Path("runs/decoupled") / task.name / name
    open_run(folder, config, ignore=("run", "cache", "compute", "logger"))
    if (folder / "eval.json").exists():
        result = read_json(folder / "eval.json")
        if world_model:
            check_same(world_model, result, folder)
        print(f"{folder} is complete; delete it to run again\n\n{row_text(result, paper_numbers(result))}")
        return

    config = replace(config, world_model=replace(config.world_model, augmentation=augmentation))
    torch.set_num_threads(config.compute.threads)
    with first_rank_first():
        dataset = find_or_record(config.task, config.dataset, folder, config.compute.threads)
    episodes, constants = load_demonstrations(dataset, config.cache)
    if world_model is None:
        seed_everything(config.world_model.seed)
        world_model = build_world_model(constants, config.world_model, episodes["train"]).to(device)
        common = {"logger": config.logger, "by_entry": not task.planar}
        train_world_model(world_model, episodes, folder, config.world_model, **common)
    if leave_ranks():
        return  # policies are small: the first process trains them
    judge = partial(judge_in_closed_loop, task=config.task, settings=config.eval)
    fingerprint = train_policies(
        world_model, episodes, constants, folder, config.policy,
        judge=judge, task=config.task, seeds=seeds, compute=config.compute, logger=config.logger,
    )  # fmt: skip
    settings = plain_settings(config)
    if config.pretrained:  # its other settings are those of its own run
        settings["world_model"] = {"supervision": config.world_model.supervision}
    result = write_report(
        folder, world_model, episodes["eval"], seeds,
        task=config.task, dataset=dataset, policy=config.policy.kind, origin=origin,
        settings=settings, command=command_line(sys.argv), frozen=fingerprint, compare=paper_numbers,
    )  # fmt: skip
    print(f"\n{row_text(result, paper_numbers(result))}\nwritten: {folder}")


def load_pretrained(config: Config):
    """Load the world model of another run of the same task and supervision."""
    from dynmap_rl.modules.supervision import parse_supervision
    from dynmap_rl.runs.lookup import load_world_model_of

    names = [field.name for field in fields(WorldModelTraining) if field.name != "supervision"]
    refuse(config.world_model, WorldModelTraining(), names, "--pretrained", "world_model.")
    world_model, origin = load_world_model_of(config.pretrained)
    expected = {"task": config.task, "training": "decoupled"}
    if origin != expected or world_model.supervision != parse_supervision(config.world_model.supervision):
        raise ValueError(
            f"--pretrained must be a decoupled world model of {config.task} with --world_model.supervision "
            f"{config.world_model.supervision}, got {origin} with {world_model.supervision}; for another task use "
            "recipes/generalize.py"
        )
    return world_model


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
