"""Decoupled training (paper, Sec. III-B): pretrain a world model, freeze it, train policies on its states, evaluate.

    python recipes/decoupled.py                                       # RGB+[P+V], recurrent policy
    python recipes/decoupled.py --supervision none --policy feedforward

With no option it records the demonstrations with the shipped expert first. The same command on the same run folder
goes on where it was stopped, or says that it is done.
"""

import multiprocessing
import shutil
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.runs import run_recipe, start_worker


@dataclass
class Config:
    # Name of the task.
    task: str = "balance_reaching"
    # Which dynamics the world model is supervised on: any of position,velocity,acceleration, or none (Only-RGB).
    supervision: str = "position,velocity"
    # Policy: feedforward or recurrent.
    policy: str = "recurrent"
    # Seeds of the policies, and of the world model.
    seeds: str = "0,1,2"
    world_model_seed: int = 0
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded if it is not there.
    dataset: str | None = None
    # Run folder; by default runs/decoupled/TASK/SUPERVISION_POLICY.
    run: Path | None = None
    # A world model that is trained already (a folder of another run); by default one is trained here.
    world_model: Path | None = None
    # World model: optimiser steps, windows a step, steps a window, decoded frames a window, peak learning rate.
    updates: int = 2500
    windows: int = 16
    window_steps: int = 24
    rgb_steps: int = 8
    learning_rate: float = 2e-3
    beta_z: float = 0.1
    beta_dynamics: float = 1.0
    # Spatial-softmax keypoints beside the plain CNN's features (beyond the paper).
    keypoints: bool = False
    # Policy: optimiser steps, episodes a step, augmented copies of every demonstration, peak learning rate.
    policy_updates: int = 1500
    policy_batch: int = 32
    copies: int = 2
    policy_learning_rate: float = 1e-3
    # Evaluation: scenes of the paper's protocol, shared start states, and the split they are of: test, or validation
    # for choosing settings.
    split: str = "test"
    paper_episodes: int = 50
    test_episodes: int = 1000
    # Every stage in a minimal size, for tests.
    smoke: bool = False
    threads: int = 2


SMOKE = {
    "updates": 4, "windows": 2, "window_steps": 6, "rgb_steps": 2, "policy_updates": 3, "policy_batch": 2,
    "copies": 1, "paper_episodes": 2, "test_episodes": 3, "seeds": "0",
}  # fmt: skip


def main(config: Config) -> None:
    import torch

    from dynmap_rl import data, modules, runs
    from dynmap_rl.evaluation import parse_supervision, print_row, write_report
    from dynmap_rl.training import fingerprint, train_world_model

    if config.smoke:
        for name, value in SMOKE.items():
            if getattr(config, name) == getattr(Config, name):  # what was asked for stays
                setattr(config, name, value)
    supervision = parse_supervision(config.supervision)
    seeds = check(config)
    trained = modules.load_world_model(config.world_model) if config.world_model else None
    if trained is not None and trained.supervision != supervision:
        raise ValueError(f"{config.world_model} is supervised on {trained.supervision}, not on {supervision}")
    name = f"{'_'.join(supervision) or 'none'}_{config.policy}{'_smoke' if config.smoke else ''}"
    folder = config.run or Path("runs/decoupled") / config.task / name
    folder = runs.open_run(folder, config, ignore=("run", "threads"))
    if (folder / "eval.json").exists():
        print(f"{folder} is done; delete it to run again")
        return print_row(runs.read_json(folder / "eval.json"))
    torch.set_num_threads(config.threads)

    dataset = config.dataset or record(config)
    constants = data.load_meta(dataset)["normalization"]
    episodes = {split: data.load_dataset(dataset, split) for split in ("train", "eval")}

    world_model = trained
    if world_model is None:
        runs.seed_everything(config.world_model_seed)
        world_model = modules.make_world_model(constants, supervision, keypoints=config.keypoints)
        train_world_model(world_model, episodes, folder, config)
    world_model.eval().requires_grad_(False)
    frozen = fingerprint(world_model)
    modules.save_world_model(folder / "world_model", world_model)

    generator = torch.Generator().manual_seed(0)
    features = data.compute_features(world_model, episodes["train"], config.copies, generator)
    held_out = data.compute_features(world_model, episodes["eval"])
    features.memmap(folder / "features" / "train")
    held_out.memmap(folder / "features" / "eval")

    todo = [seed for seed in seeds if not (folder / f"seed_{seed}" / "eval.json").exists()]
    run_seeds([(config, folder, constants, seed, frozen) for seed in todo])
    shutil.rmtree(folder / "features")
    if fingerprint(modules.load_world_model(folder / "world_model")) != frozen:
        raise ValueError(f"the frozen world model of {folder} has changed; delete the folder and run again")
    result = write_report(folder, config, dataset, world_model, episodes["eval"], seeds, frozen)
    print_row(result)
    print(f"figures, rollouts and eval.json are in {folder}")


def check(config: Config) -> list[int]:
    """Refuse what cannot run, before anything is written; returns the policy seeds."""
    from dynmap_rl import data, modules
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.envs.world import EPISODE_STEPS
    from dynmap_rl.evaluation import SHARED_STARTS

    get_task(config.task)
    modules.check_policy(config.policy)
    try:
        seeds = [int(seed) for seed in config.seeds.split(",")]
    except ValueError as error:
        raise ValueError(f"--seeds are whole numbers such as 0,1,2, not {config.seeds!r}") from error
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"--seeds {config.seeds} has one twice")
    if not 2 <= config.window_steps <= EPISODE_STEPS:
        raise ValueError(f"--window_steps must be 2 to {EPISODE_STEPS}, not {config.window_steps}")
    if config.split not in ("test", "validation"):
        raise ValueError(f"--split is test or validation, not {config.split!r}")
    if config.test_episodes > SHARED_STARTS:
        raise ValueError(f"there are {SHARED_STARTS} shared start states, not {config.test_episodes}")
    if min(config.updates, config.policy_updates, config.test_episodes, config.paper_episodes) < 1:
        raise ValueError("updates and episodes must be at least 1")
    if config.dataset and (task := data.load_meta(config.dataset)["task"]) != config.task:
        raise ValueError(f"{config.dataset} holds the task {task}, not {config.task}")
    return seeds


def record(config: Config) -> Path:
    from dynmap_rl.data import record_dataset

    if config.smoke:
        return record_dataset(
            f"datasets/{config.task}_smoke", config.task, episodes=4, eval_episodes=2, workers=1
        )
    return record_dataset(f"datasets/{config.task}", config.task)


def run_seeds(arguments: list[tuple]) -> None:
    """Two at a time, each in a process of its own; one alone in this one."""
    if len(arguments) <= 1:
        return list(map(train_and_evaluate, arguments))
    context = multiprocessing.get_context("spawn")
    try:
        with ProcessPoolExecutor(2, mp_context=context, initializer=start_worker) as pool:
            list(pool.map(train_and_evaluate, arguments))
    except BrokenProcessPool as error:
        raise OSError("a policy's process died (of memory?); the same command goes on") from error


def train_and_evaluate(arguments) -> None:
    """One policy seed: train, evaluate, and prove that the world model stayed as it was."""
    config, folder, constants, seed, frozen = arguments
    import torch
    from tensordict import TensorDict

    from dynmap_rl import modules, runs
    from dynmap_rl.evaluation import evaluate
    from dynmap_rl.training import fingerprint, train_policy

    torch.set_num_threads(1)
    runs.seed_everything(1000 + seed)
    world_model = modules.load_world_model(folder / "world_model").requires_grad_(False)
    policy = modules.make_policy(constants, config.policy, world_model)
    features = TensorDict.load_memmap(folder / "features" / "train")
    held_out = TensorDict.load_memmap(folder / "features" / "eval")
    train_policy(policy, features, held_out, folder / f"seed_{seed}", config, seed)
    modules.save_policy(folder / f"seed_{seed}" / "policy", policy, world_model)
    result = evaluate(
        world_model, policy, config.task, config.test_episodes, config.paper_episodes, config.split
    )
    result["world_model_sha256"] = fingerprint(world_model)
    if result["world_model_sha256"] != frozen:
        raise ValueError("the frozen world model has changed; this run is not valid")
    runs.write_json(folder / f"seed_{seed}" / "eval.json", result)


if __name__ == "__main__":
    run_recipe(main, Config)
