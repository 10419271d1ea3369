"""End-to-end training (paper, Sec. III-B, Eq. 3): the policy's loss alone, through encoder and transition; evaluate.

    python recipes/end_to_end.py
    python recipes/end_to_end.py --policy.kind feedforward

Every seed has a world model of its own; recipes/generalize.py uses the first one. Demonstrations are recorded with
the shipped expert where they are missing. The same command resumes a stopped run, and prints the result of a finished
one.
"""

import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.training.settings import EndToEndTraining, PolicyArchitecture, WorldModelArchitecture
from dynmap_rl.utils.cli import command_line, parse_seeds, run_recipe
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
    # Run folder; by default runs/end_to_end/TASK/KIND.
    run: Path | None = None
    # Seeds of world models and policies.
    seeds: str = "0,1,2"
    # World model, of which encoder and transition are trained; without dynamics.
    world_model: WorldModelArchitecture = WorldModelArchitecture("none")
    # Policy.
    policy: PolicyArchitecture = PolicyArchitecture()
    # Training of both.
    training: EndToEndTraining = EndToEndTraining()
    # Evaluation in closed loop.
    eval: Evaluation = Evaluation()
    # Device, cores and processes.
    compute: RankedCompute = RankedCompute()
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None

    def __post_init__(self):
        if self.world_model.supervision != "none":
            raise ValueError("--world_model.supervision must be none for end-to-end training; see joint.py")


def main(config: Config) -> None:
    """Train, evaluate and report."""
    if config.compute.launcher == "ray":
        return train_by_ray(main, config, sys.argv)
    from dynmap_rl.data.demonstrations import load_demonstrations
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.protocol import judge_in_closed_loop
    from dynmap_rl.paper.published import paper_numbers
    from dynmap_rl.reporting.run_page import row_text, write_report
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.training.dataset import check_dataset, choose_augmentation, find_or_record
    from dynmap_rl.training.joint import train_seeds
    from dynmap_rl.training.settings import check_window_steps
    from dynmap_rl.utils.devices import choose_device
    from dynmap_rl.utils.files import read_json
    from dynmap_rl.utils.ranks import first_rank_first, join_ranks, leave_ranks

    join_ranks(config.compute.device)
    task, seeds = get_task(config.task), parse_seeds(config.seeds)
    choose_device(config.compute.device)
    augmentation = choose_augmentation(task, config.training.augmentation, imitated=True)
    check_window_steps(config.training, task.layout.steps, "training")
    check_logger(config.logger)
    if config.dataset:
        check_dataset(config.dataset, config.task)
    folder = config.run or Path("runs/end_to_end") / task.name / config.policy.kind
    open_run(folder, config, ignore=("run", "cache", "compute", "logger"))
    if (folder / "eval.json").exists():
        result = read_json(folder / "eval.json")
        print(f"{folder} is complete; delete it to run again\n\n{row_text(result, paper_numbers(result))}")
        return

    with first_rank_first():
        dataset = find_or_record(config.task, config.dataset, folder, config.compute.threads)
    training = replace(config.training, augmentation=augmentation)
    config = replace(config, training=training)
    load = partial(load_demonstrations, dataset, config.cache)
    world_model = train_seeds(
        load, folder, config.world_model, config.policy, training,
        judge=partial(judge_in_closed_loop, task=config.task, settings=config.eval),
        seeds=seeds, compute=config.compute, logger=config.logger,
    )  # fmt: skip
    if leave_ranks():
        return
    result = write_report(
        folder, world_model, load()[0]["eval"], seeds,
        task=config.task, dataset=dataset, policy=config.policy.kind,
        origin={"task": config.task, "training": "end_to_end"},
        settings=plain_settings(config), command=command_line(sys.argv), compare=paper_numbers,
    )  # fmt: skip
    print(f"\n{row_text(result, paper_numbers(result))}\nwritten: {folder}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
