"""Train on a robot dataset: any LeRobot v3.0 dataset with an action, a camera and dynamics columns.

    python recipes/add_dynamics.py --dataset user/name --columns 0,1,2 --output datasets/mine
    python recipes/robot.py --dataset datasets/mine
    python recipes/robot.py --dataset datasets/mine --method joint --goal observation.state:3,4

World model and policies are trained in decoupled form (recipes/decoupled.py) or jointly (recipes/joint.py). Without a
simulator there is no closed loop: the result is the errors on held-out episodes. The same command resumes a stopped
run, and prints the result of a finished one.
"""

import os
import sys
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.training.settings import (
    JointTraining,
    PolicyArchitecture,
    PolicyTraining,
    WorldModelArchitecture,
    WorldModelTraining,
)
from dynmap_rl.utils.cli import command_line, parse_seeds, refuse, run_recipe
from dynmap_rl.utils.devices import Compute

# The symmetries of the tasks' scenes, and the weight of changed actions, need not hold for a robot.
WORLD_MODEL = WorldModelTraining(augmentation=Augmentation.off())
POLICY = PolicyTraining(emphasis=0.0)
JOINT = JointTraining(augmentation=Augmentation.off(), emphasis=0.0)


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Dataset: a folder or a hub id. Required.
    dataset: str | None = None
    # Camera's column, or several with commas between; by default the first camera.
    camera: str | None = None
    # Side of the frames of a camera in pixels, a multiple of 8; frames are resized.
    image_size: int = 64
    # Goal's column and entries, such as observation.state:3,4; by default no goal.
    goal: str | None = None
    # decoupled (world model first, then policies on its states) or joint (one loss).
    method: str = "decoupled"
    # Run folder; by default runs/robot/DATASET/METHOD_SUPERVISION_KIND.
    run: Path | None = None
    # Seeds of the policies.
    seeds: str = "0,1,2"
    # World model.
    world_model: WorldModelTraining = WORLD_MODEL
    # Policies.
    policy: PolicyTraining = POLICY
    # Joint training, with --method joint.
    joint: JointTraining = JOINT
    # Device and cores.
    compute: Compute = Compute()
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None


def main(config: Config) -> None:
    """Train, measure and report."""
    import torch

    from dynmap_rl.data.robot import describe_robot_dataset, load_robot_dataset
    from dynmap_rl.evaluation.errors import judge_held_out
    from dynmap_rl.modules.supervision import parse_supervision
    from dynmap_rl.reporting.robot_page import robot_row_text, write_robot_report
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.training.dagger import check_corrections
    from dynmap_rl.training.dataset import keep_dataset
    from dynmap_rl.training.decoupled import check_copies, train_policies
    from dynmap_rl.training.joint import train_seeds
    from dynmap_rl.training.world_model import build_world_model, train_world_model
    from dynmap_rl.utils.devices import choose_device, seed_everything
    from dynmap_rl.utils.files import read_json

    check_config(config)
    seeds, device = parse_seeds(config.seeds), choose_device(config.compute.device)
    check_logger(config.logger)
    check_corrections(config.policy, None)
    check_copies(config.policy, None)
    supervision = parse_supervision(config.world_model.supervision)
    steps = (config.joint if config.method == "joint" else config.world_model).window_steps
    data = describe_robot_dataset(config.dataset, config.camera, config.goal, supervision, steps)
    folder = config.run or default_folder(config)
    open_run(folder, config, ignore=("run", "compute", "logger"))
    keep_dataset(folder, config.dataset)
    if (folder / "eval.json").exists():
        result = read_json(folder / "eval.json")
        print(f"{folder} is complete; delete it to run again\n\n{robot_row_text(result)}")
        return

    torch.set_num_threads(config.compute.threads)
    print(describe_pieces(data))
    load = partial(load_robot_dataset, config.dataset, steps, config.camera, config.goal, config.image_size)
    judge, fingerprint = partial(judge_held_out, load=partial(load, only="eval")), None
    episodes, constants = load()
    common = {"judge": judge, "seeds": seeds, "compute": config.compute, "logger": config.logger}
    if config.method == "joint":
        parts = config.world_model, config.policy, config.joint
        world_model = train_seeds(load, folder, *parts, by_entry=True, **common)
        judged = judge_world_model(world_model, episodes)
    else:
        seed_everything(config.world_model.seed)
        world_model = build_world_model(constants, config.world_model, episodes["train"]).to(device)
        settings = config.world_model
        train_world_model(world_model, episodes, folder, settings, logger=config.logger, by_entry=True)
        judged = judge_world_model(world_model, episodes)
        fingerprint = train_policies(world_model, episodes, constants, folder, config.policy, **common)
    result = write_robot_report(
        folder, world_model, episodes["eval"], seeds,
        dataset=config.dataset, camera=config.camera, goal=config.goal, policy=config.policy.kind,
        origin={"training": config.method, "dataset": config.dataset},
        settings=plain_settings(config), command=command_line(sys.argv), frozen=fingerprint,
        judged=judged,
    )  # fmt: skip
    print(f"\n{robot_row_text(result)}\nwritten: {folder}")


def check_config(config: Config) -> None:
    """Raise ``ValueError`` for a missing dataset, an unknown method, a wrong size, or options that have no effect."""
    import torch

    from dynmap_rl.modules.world_model import ARCHITECTURES

    if not config.dataset:
        raise ValueError("--dataset must be a folder or a hub id; name the dataset to train on")
    if config.method not in ("decoupled", "joint"):
        raise ValueError(f"--method must be decoupled or joint, got {config.method!r}")
    for part in (config.world_model, config.joint):
        if part.augmentation.mirror or part.augmentation.max_shift:
            raise ValueError(
                "augmentation.mirror and .max_shift must be off: a robot's entries have no known mirror image"
            )
    if config.image_size < 8 or config.image_size % 8:
        raise ValueError(f"--image_size must be a multiple of 8, got {config.image_size}")
    with torch.device("meta"):  # the encoder refuses sizes that it cannot have, before the videos are decoded
        ARCHITECTURES[config.world_model.architecture][0](64, image_size=config.image_size)

    def own(settings: type, base: type) -> list[str]:
        return [field.name for field in fields(settings) if field.name not in {f.name for f in fields(base)}]

    other = f"--method {config.method}"
    if config.method == "joint":
        names = own(WorldModelTraining, WorldModelArchitecture)
        refuse(config.world_model, WORLD_MODEL, names, other, "world_model.")
        refuse(config.policy, POLICY, own(PolicyTraining, PolicyArchitecture), other, "policy.")
        if config.world_model.supervision == "none":
            refuse(config.joint, JOINT, ["beta_dynamics"], "supervision none", "joint.")
    else:
        refuse(config.joint, JOINT, [field.name for field in fields(JointTraining)], other, "joint.")


def describe_pieces(data: dict) -> str:
    """Return what is trained on and held out as text."""
    held_out = ", ".join(map(str, data["splits"]["eval"]))
    text = f"frames of {', '.join(data['cameras'])}; pieces of {data['steps']} steps"
    if data["steps"] in (lengths := data["lengths"]).values():  # otherwise all are longer
        text += f", as long as episode {next(e for e, n in lengths.items() if n == data['steps'])}"
    text += f"; held out: episodes {held_out}"
    if data["left_out"]:
        text += f"; left out, as too short: {', '.join(map(str, data['left_out']))}"
    if data["info"].get("total_tasks", 1) > 1 and not data["goal"]:
        text += "\nthe dataset has several tasks, which a policy tells apart by --goal alone, such as task_index:0"
    return text


def judge_world_model(world_model, episodes: dict) -> dict | None:
    """Judge a world model by linear maps to the dynamics, and print the verdict; None for a dataset without dynamics."""
    from dynmap_rl.evaluation.probing import judge_states, judged_text, probe
    from dynmap_rl.keys import DYNAMICS

    if any(("dynamics", quantity) not in episodes["eval"].keys(True) for quantity in DYNAMICS):
        return None
    judged = judge_states(probe(world_model, episodes["train"][:100], episodes["eval"]))
    print(f"world model: {judged_text(judged)}")
    return judged


def default_folder(config: Config) -> Path:
    """Return the run folder of the settings."""
    dataset = os.path.basename(os.path.abspath(config.dataset))  # never ".."
    supervision = config.world_model.supervision.replace(",", "_")
    return Path("runs/robot") / dataset / f"{config.method}_{supervision}_{config.policy.kind}"


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
