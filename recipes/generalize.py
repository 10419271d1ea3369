"""Generalisation (paper, Sec. V-D): policies for task 2 or 3 on a frozen world model of task 1.

    python recipes/decoupled.py                                  # trains the world model of task 1
    python recipes/generalize.py --task balance_reaching_obstacle
    python recipes/generalize.py --task bin_dropping --world_model runs/decoupled/balance_reaching/none_recurrent

Compares with the paper's Tables II and III. The same command on the same run folder goes on where it was stopped,
or says that it is done.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.commands import replace_defaults, run_recipe


@dataclass
class Config:
    # Name of the task to learn: balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching_obstacle"
    # Run folder that a world model was trained in.
    world_model: Path = Path("runs/decoupled/balance_reaching/position_velocity_recurrent")
    # Policy: feedforward or recurrent.
    policy: str = "recurrent"
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded if it is not there.
    dataset: str | None = None
    # Run folder; by default runs/generalize/TASK/TRAINING_SUPERVISION_POLICY.
    run: Path | None = None
    # Policy: optimiser steps, episodes a step, augmented copies of every demonstration, peak learning rate.
    policy_updates: int = 2500
    policy_batch: int = 32
    copies: int = 2
    policy_learning_rate: float = 3e-3
    # Weight of the steps in which the expert changes its action (see imitation_loss); 0 for the paper's plain L1.
    emphasis: float = 60.0
    # Evaluation: scenes of the paper's protocol, shared start states, and the split they are of: test, or validation
    # for choosing settings.
    split: str = "test"
    paper_episodes: int = 50
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

    from dynmap_rl import data, frozen, runs, settings
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation import print_row, write_report
    from dynmap_rl.training import fingerprint

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
        if result["world_model_sha256"] != fingerprint(world_model):
            raise ValueError(
                f"{folder} was made with another world model; choose another --run, or delete it"
            )
        print(f"{folder} is done; delete it to run again")
        return print_row(result)
    torch.set_num_threads(config.threads)

    dataset = settings.find_or_record(config)
    constants = data.load_meta(dataset)["normalization"]
    episodes = {split: data.load_dataset(dataset, split) for split in ("train", "eval")}
    fingerprint = frozen.train_policies(world_model, episodes, constants, folder, config, seeds)
    result = write_report(folder, config, dataset, world_model, episodes["eval"], seeds, fingerprint, source)
    print_row(result)
    print(f"figures, rollouts and eval.json are in {folder}")


if __name__ == "__main__":
    run_recipe(main, Config)
