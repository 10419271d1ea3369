"""Generalisation (paper, Sec. V-C): policies for task 2 or 3 on a frozen world model of task 1.

    python recipes/generalize.py --task balance_reaching_obstacle    # on the shipped world model
    python recipes/decoupled.py --world_model.supervision none
    python recipes/generalize.py --task bin_dropping --pretrained runs/decoupled/balance_reaching/none_recurrent

Demonstrations are recorded with the shipped expert where they are missing. The same command resumes a stopped run, and
prints the result of a finished one.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.training.settings import PolicyTraining
from dynmap_rl.utils.cli import command_line, parse_seeds, run_recipe
from dynmap_rl.utils.devices import Compute


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task to learn: balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching_obstacle"
    # Run whose world model is used: a folder, a hub id, or balance_reaching (shipped).
    pretrained: str = "balance_reaching"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded where it is missing.
    dataset: str | None = None
    # Folder for decoded datasets; by default DATASET.cache beside the dataset.
    cache: Path | None = None
    # Run folder; by default runs/generalize/TASK/TRAINING_SUPERVISION_KIND.
    run: Path | None = None
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # Policies.
    policy: PolicyTraining = PolicyTraining(updates=3000)
    # Evaluation in closed loop.
    eval: Evaluation = Evaluation()
    # Device and cores.
    compute: Compute = Compute()
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None


def main(config: Config) -> None:
    """Train, evaluate and report."""
    import torch

    from dynmap_rl.data.demonstrations import load_demonstrations
    from dynmap_rl.envs.task import Task
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.protocol import judge_in_closed_loop
    from dynmap_rl.paper.published import paper_numbers
    from dynmap_rl.reporting.run_page import row_text, write_report
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.runs.lookup import check_actions, load_world_model_of
    from dynmap_rl.training.dagger import check_corrections
    from dynmap_rl.training.dataset import check_dataset, find_or_record
    from dynmap_rl.training.decoupled import check_copies, check_same, train_policies
    from dynmap_rl.utils.devices import choose_device
    from dynmap_rl.utils.files import read_json

    task, seeds = get_task(config.task, kind=Task), parse_seeds(config.seeds)
    choose_device(config.compute.device)
    check_logger(config.logger)
    check_corrections(config.policy, config.task, seeds)
    check_copies(config.policy, config.task)
    if config.dataset:
        check_dataset(config.dataset, config.task)
    world_model, origin = load_world_model_of(config.pretrained)
    if origin.get("task") == config.task:
        raise ValueError(
            f"--task must differ from the task of --pretrained, got {config.task} for both; choose another --task, or "
            "use recipes/decoupled.py"
        )
    check_actions(world_model, origin, task, config.pretrained)
    name = f"{origin['training']}_{'_'.join(world_model.supervision) or 'none'}_{config.policy.kind}"
    folder = config.run or Path("runs/generalize") / task.name / name
    open_run(folder, config, ignore=("run", "cache", "compute", "logger"))
    if (folder / "eval.json").exists():
        result = read_json(folder / "eval.json")
        check_same(world_model, result, folder)
        print(f"{folder} is complete; delete it to run again\n\n{row_text(result, paper_numbers(result))}")
        return

    torch.set_num_threads(config.compute.threads)
    dataset = find_or_record(config.task, config.dataset, folder, config.compute.threads)
    episodes, constants = load_demonstrations(dataset, config.cache)
    judge = partial(judge_in_closed_loop, task=config.task, settings=config.eval)
    fingerprint = train_policies(
        world_model, episodes, constants, folder, config.policy,
        judge=judge, task=config.task, seeds=seeds, compute=config.compute, logger=config.logger,
    )  # fmt: skip
    result = write_report(
        folder, world_model, episodes["eval"], seeds,
        task=config.task, dataset=dataset, policy=config.policy.kind, origin=origin,
        settings=plain_settings(config), command=command_line(sys.argv), frozen=fingerprint, compare=paper_numbers,
    )  # fmt: skip
    print(f"\n{row_text(result, paper_numbers(result))}\nwritten: {folder}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
