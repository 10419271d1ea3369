"""Decoupled training (paper, Sec. III-B): pretrain a world model, freeze it, train policies on its states, evaluate.

    python recipes/decoupled.py                                       # RGB+[P+V], recurrent policy
    python recipes/decoupled.py --supervision none --policy feedforward
    python recipes/decoupled.py --task bin_dropping
    python recipes/decoupled.py --task none --dataset datasets/mine   # a robot's dataset with dynamics columns

With no option it records the demonstrations with the shipped expert first. The same command on the same run folder
goes on where it was stopped, or says that it is done.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import refuse
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
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # Seed of the world model.
    world_model_seed: int = 0
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded if it is not there.
    dataset: str | None = None
    # With --task none: the camera's column; by default the first.
    camera: str | None = None
    # With --task none: the goal's column and entries, such as observation.state:3,4; by default no goal.
    goal: str | None = None
    # Run folder; by default runs/decoupled/TASK/SUPERVISION_POLICY.
    run: Path | None = None
    # Run folder whose world model is taken, its id on the hub, or balance_reaching, which ships with the package: of the
    # same task and supervision. By default one is trained here.
    world_model: Path | None = None
    # Optimiser steps of the world model.
    updates: int = 2500
    # Windows a step.
    windows: int = 16
    # Time steps a window.
    window_steps: int = 24
    # Frames decoded a window, drawn at random.
    rgb_steps: int = 8
    # Peak learning rate of the world model (100 steps of warm-up, then a cosine).
    learning_rate: float = 2e-3
    # Weight of the latent's loss (Eq. 4a).
    beta_z: float = 0.1
    # Weight of the loss of every supervised quantity (Eq. 5).
    beta_dynamics: float = 1.0
    # Bars painted on the background of a window, at most (see dynmap_rl.data.augmentation.add_distractors); 0 for none.
    distractors: int = 3
    # Spatial-softmax keypoints beside the plain CNN's features (beyond the paper).
    keypoints: bool = False
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
    # Cores: threads of the world model's training, then policies trained at a time.
    threads: int = 2
    # Metrics to tensorboard, wandb or trackio as well, where it is installed.
    logger: str | None = None


WORLD_MODEL = (  # what says nothing where the world model is there
    "world_model_seed", "updates", "windows", "window_steps", "rgb_steps", "learning_rate", "beta_z", "beta_dynamics",
    "distractors", "keypoints",
)  # fmt: skip
SMOKE = {
    "updates": 4, "windows": 2, "window_steps": 6, "rgb_steps": 2, "policy_updates": 3, "policy_batch": 2,
    "copies": 1, "paper_episodes": 2, "test_episodes": 3, "seeds": "0",
}  # fmt: skip


def main(config: Config) -> None:
    import torch

    from dynmap_rl import frozen  # MODULE
    from dynmap_rl import modules  # MODULE
    from dynmap_rl import runs  # MODULE
    from dynmap_rl import settings  # MODULE
    from dynmap_rl.envs.tasks import NO_TASK
    from dynmap_rl.modules.supervision import parse_supervision
    from dynmap_rl.reporting.run_page import print_row
    from dynmap_rl.reporting.run_page import write_report
    from dynmap_rl.training.world_model import train_world_model

    if config.world_model:
        refuse(config, WORLD_MODEL, "is of a world model's training, and that of --world_model is done")
    if config.smoke:
        replace_defaults(config, SMOKE)
    if config.task == NO_TASK:
        replace_defaults(config, settings.FOREIGN)
    supervision = parse_supervision(config.supervision)
    seeds = settings.check_settings(config)
    trained = None
    if config.world_model:
        trained, source = frozen.load_source(config.world_model)
        if source != settings.describe_source(config, "decoupled") or trained.supervision != supervision:
            raise ValueError(
                f"{config.world_model} is a world model of {source.get('dataset', source['task'])}, {source['training']}, supervised on "
                f"{trained.supervision}; for another task use recipes/generalize.py"
            )
    name = f"{'_'.join(supervision) or 'none'}_{config.policy}{'_smoke' if config.smoke else ''}"
    folder = config.run or Path("runs/decoupled") / settings.name_task(config) / name
    folder = runs.open_run(folder, config, ignore=("run", "threads", "device", "logger"))
    if (folder / "eval.json").exists():
        result = runs.read_json(folder / "eval.json")
        if trained:
            frozen.check_same(trained, result, folder)
        print(f"{folder} is done; delete it to run again")
        return print_row(result)
    torch.set_num_threads(config.threads)

    dataset = settings.find_or_record(config)
    episodes, constants = settings.load_episodes(config, dataset)

    world_model = trained
    if world_model is None:
        runs.seed_everything(config.world_model_seed)
        world_model = modules.make_world_model(constants, supervision, keypoints=config.keypoints)
        world_model.to(runs.choose_device(config.device))
        train_world_model(world_model, episodes, folder, config)
    fingerprint = frozen.train_policies(world_model, episodes, constants, folder, config, seeds)
    result = write_report(folder, config, dataset, world_model, episodes["eval"], seeds, fingerprint)
    print_row(result)
    print(f"eval.json and all else is in {folder}")


if __name__ == "__main__":
    run_recipe(main, Config)
