"""Joint training (paper, Sec. III-B, Eq. 4 and 5): world model and policy as one, with one optimiser; evaluate.

    python recipes/joint.py                                       # RGB+[P+V], recurrent policy
    python recipes/joint.py --supervision none --policy feedforward

Every seed has a world model of its own; recipes/generalize.py takes that of the first. With no option it records the
demonstrations with the shipped expert first. The same command on the same run folder goes on where it was stopped, or
says that it is done.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import replace_defaults
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, module:Class of your own, or
    # none for a LeRobot dataset of any other task (--dataset; see README, "Your own robot's dataset").
    task: str = "balance_reaching"
    # Which dynamics the world model is supervised on: any of position,velocity,acceleration, or none (Only-RGB).
    supervision: str = "position,velocity"
    # Policy: feedforward or recurrent.
    policy: str = "recurrent"
    # Seeds of world model and policy.
    seeds: str = "0,1,2"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded if it is not there.
    dataset: str | None = None
    # With --task none: the camera's column; by default the first.
    camera: str | None = None
    # With --task none: the goal's column and entries, such as observation.state:3,4; by default no goal.
    goal: str | None = None
    # Run folder; by default runs/joint/TASK/SUPERVISION_POLICY.
    run: Path | None = None
    # Optimiser steps.
    updates: int = 2500
    # Windows a step.
    windows: int = 8
    # Time steps a window.
    window_steps: int = 48
    # Frames decoded a window, drawn at random.
    rgb_steps: int = 16
    # Peak learning rate (100 steps of warm-up, then a cosine).
    learning_rate: float = 2e-3
    # Weight of the latent's loss (Eq. 4a).
    beta_z: float = 0.1
    # Weight of the loss of every supervised quantity (Eq. 5).
    beta_dynamics: float = 1.0
    # Weight of the policy's loss (Eq. 4).
    beta_joint: float = 1.0
    # Weight of the steps in which the expert changes its action (see imitation_loss); 0 for the paper's plain L1.
    emphasis: float = 60.0
    # Bars painted on the background of a window, at most (see dynmap_rl.data.augmentation.add_distractors); 0 for none.
    distractors: int = 3
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
    # Seeds trained at a time, each on one core.
    threads: int = 2
    # Metrics to tensorboard, wandb or trackio as well, where it is installed.
    logger: str | None = None


SMOKE = {
    "updates": 4, "windows": 2, "window_steps": 6, "rgb_steps": 2, "paper_episodes": 2, "test_episodes": 3, "seeds": "0",
}  # fmt: skip


def main(config: Config) -> None:
    from dynmap_rl import joint  # MODULE
    from dynmap_rl import modules  # MODULE
    from dynmap_rl import runs  # MODULE
    from dynmap_rl import settings  # MODULE
    from dynmap_rl.envs.tasks import NO_TASK
    from dynmap_rl.modules.supervision import parse_supervision
    from dynmap_rl.reporting.run_page import print_row
    from dynmap_rl.reporting.run_page import write_report

    if config.smoke:
        replace_defaults(config, SMOKE)
    if config.task == NO_TASK:
        replace_defaults(config, settings.FOREIGN)
    supervision = parse_supervision(config.supervision)
    seeds = settings.check_settings(config)
    name = f"{'_'.join(supervision) or 'none'}_{config.policy}{'_smoke' if config.smoke else ''}"
    folder = config.run or Path("runs/joint") / settings.name_task(config) / name
    folder = runs.open_run(folder, config, ignore=("run", "threads", "device", "logger"))
    if (folder / "eval.json").exists():
        print(f"{folder} is done; delete it to run again")
        return print_row(runs.read_json(folder / "eval.json"))

    dataset = settings.find_or_record(config)
    joint.train_seeds(dataset, supervision, folder, config, seeds)
    world_model = modules.load_world_model(folder / f"seed_{seeds[0]}" / "world_model")
    modules.save_world_model(folder / "world_model", world_model)
    source = settings.describe_source(config, "joint")
    episodes, _ = settings.load_episodes(config, dataset)
    result = write_report(folder, config, dataset, world_model, episodes["eval"], seeds, source=source)
    print_row(result)
    print(f"eval.json and all else is in {folder}")


if __name__ == "__main__":
    run_recipe(main, Config)
