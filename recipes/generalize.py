"""Generalisation (paper, Sec. V-D): policies for task 2 or 3 on a frozen world model of task 1.

    python recipes/decoupled.py                                  # trains the world model of task 1
    python recipes/generalize.py --task balance_reaching_obstacle
    python recipes/generalize.py --task bin_dropping --world_model runs/decoupled/balance_reaching/none_recurrent

Compares with the paper's Tables II and III. The same command on the same run folder goes on where it was stopped,
or says that it is done.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import replace_defaults
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Name of the task to learn: balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching_obstacle"
    # Run folder that a world model was trained in, its id on the hub, or balance_reaching, which ships with the package.
    world_model: Path = Path("runs/decoupled/balance_reaching/position_velocity_recurrent")
    # Policy: feedforward or recurrent.
    policy: str = "recurrent"
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded if it is not there.
    dataset: str | None = None
    # Run folder; by default runs/generalize/TASK/TRAINING_SUPERVISION_POLICY.
    run: Path | None = None
    # Optimiser steps of a policy.
    policy_updates: int = 2500
    # Episodes a step.
    policy_batch: int = 32
    # Recoloured copies of every demonstration, beside it.
    copies: int = 2
    # Peak learning rate of a policy (100 steps of warm-up, then a cosine).
    policy_learning_rate: float = 3e-3
    # Weight of the steps in which the expert changes its action (see imitation_loss); 0 for the paper's plain L1.
    emphasis: float = 60.0
    # Scenes to evaluate on: those of test, or of validation while you choose settings.
    split: str = "test"
    # Scenes of the paper's protocol.
    paper_episodes: int = 50
    # Scenes that all policies of the tables share, 1,000 at most.
    test_episodes: int = 1000
    # Every stage in a minimal size, for tests.
    smoke: bool = False
    # cpu, cuda, or auto: the GPU where there is one.
    device: str = "auto"
    # Policies trained at a time, each on one core.
    threads: int = 2
    # Metrics to tensorboard, wandb or trackio as well, where it is installed.
    logger: str | None = None


SMOKE = {
    "policy_updates": 3, "policy_batch": 2, "copies": 1, "paper_episodes": 2, "test_episodes": 3, "seeds": "0",
}  # fmt: skip


def main(config: Config) -> None:
    import torch

    from dynmap_rl import frozen  # MODULE
    from dynmap_rl import runs  # MODULE
    from dynmap_rl import settings  # MODULE
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.reporting.run_page import print_row
    from dynmap_rl.reporting.run_page import write_report

    if config.smoke:
        replace_defaults(config, SMOKE)
    seeds = settings.check_settings(config)
    world_model, source = frozen.load_source(config.world_model)
    if source["task"] == config.task:
        raise ValueError(f"{config.world_model} was trained on {config.task} itself; choose another --task")
    name = f"{source['training']}_{'_'.join(world_model.supervision) or 'none'}_{config.policy}"
    name += "_smoke" if config.smoke else ""
    folder = config.run or Path("runs/generalize") / get_task(config.task).name / name
    folder = runs.open_run(folder, config, ignore=("run", "threads", "device", "logger"))
    if (folder / "eval.json").exists():
        result = runs.read_json(folder / "eval.json")
        frozen.check_same(world_model, result, folder)
        print(f"{folder} is done; delete it to run again")
        return print_row(result)
    torch.set_num_threads(config.threads)

    dataset = settings.find_or_record(config)
    episodes, constants = settings.load_episodes(config, dataset)
    fingerprint = frozen.train_policies(world_model, episodes, constants, folder, config, seeds)
    result = write_report(folder, config, dataset, world_model, episodes["eval"], seeds, fingerprint, source)
    print_row(result)
    print(f"eval.json and all else is in {folder}")


if __name__ == "__main__":
    run_recipe(main, Config)
