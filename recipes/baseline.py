"""Train ACT or Diffusion Policy by LeRobot's command on the demonstrations of a task; evaluate.

    python recipes/baseline.py --task mujoco:PlateSlide                        # ACT
    python recipes/baseline.py --task mujoco:PlateSlide --policy diffusion
    python recipes/baseline.py --full_size --steps 100000 --batch 8            # LeRobot's sizes, for a GPU

Needs uv pip install -e '.[lerobot]'. The policies read frames and observation.state, which holds the goal. They are smaller than
LeRobot's defaults, for two cores, and all weights begin at random. The same command resumes a stopped run at LeRobot's
last checkpoint, and prints the result of a finished one.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.utils.cli import command_line, parse_seeds, refuse, run_recipe
from dynmap_rl.utils.devices import Compute
from dynmap_rl.utils.settings import check_at_least, check_choice

TRAINED = "checkpoints/last/pretrained_model"
ROWS = {"act": "ACT", "diffusion": "Diffusion Policy"}
OPTIONS = {  # for two cores
    "act": (
        "--policy.dim_model=256", "--policy.dim_feedforward=1024", "--policy.chunk_size=20",
        "--policy.n_action_steps=10", "--policy.optimizer_lr=1e-4", "--policy.optimizer_lr_backbone=1e-4",
    ),
    "diffusion": (
        "--policy.horizon=16", "--policy.n_action_steps=8", "--policy.down_dims=[64,128,256]",
        "--policy.noise_scheduler_type=DDIM", "--policy.num_inference_steps=10", "--policy.optimizer_lr=3e-4",
        "--policy.scheduler_warmup_steps=200", "--policy.use_group_norm=true",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, mujoco:FetchPush (FetchSlide, PlateSlide, Soccer),
    # or module:Class of your own.
    task: str = "balance_reaching"
    # act or diffusion.
    policy: str = "act"
    # Dataset: a folder or a hub id; by default datasets/TASK, recorded where it is missing.
    dataset: str | None = None
    # Run folder; by default runs/baseline/TASK/POLICY.
    run: Path | None = None
    # Seeds of the policies, which are trained one after the other.
    seeds: str = "0,1,2"
    # Updates of the weights (the steps of lerobot-train).
    steps: int = 4000
    # Samples in a batch.
    batch: int = 32
    # Sizes and learning rates of LeRobot's defaults.
    full_size: bool = False
    # Evaluation in closed loop, here without the paper's protocol.
    eval: Evaluation = Evaluation(paper_episodes=0)
    # Device and cores.
    compute: Compute = Compute()

    def __post_init__(self):
        check_choice(self, "policy", tuple(OPTIONS))
        check_at_least(self, 1, "steps", "batch")


def main(config: Config) -> None:
    """Train, evaluate and report."""
    import torch

    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.reporting.run_page import row_text
    from dynmap_rl.runs.folder import open_run
    from dynmap_rl.training.dataset import check_dataset, find_or_record
    from dynmap_rl.utils.devices import choose_device
    from dynmap_rl.utils.files import read_json

    refuse(config.eval, Evaluation(paper_episodes=0), ["paper_episodes"], "recipes/baseline.py", "eval.")
    task, seeds = get_task(config.task), parse_seeds(config.seeds)
    device = choose_device(config.compute.device)
    check_lerobot()
    if config.dataset:
        check_dataset(config.dataset, config.task)
    folder = config.run or Path("runs/baseline") / task.name / config.policy
    open_run(folder, config, ignore=("run", "compute"))
    if (folder / "eval.json").exists():
        print(f"{folder} is complete; delete it to run again\n\n{row_text(read_json(folder / 'eval.json'))}")
        return
    torch.set_num_threads(config.compute.threads)
    dataset = find_or_record(config.task, config.dataset, folder, config.compute.threads)
    for seed in seeds:
        if not (folder / f"seed_{seed}/eval.json").exists():
            train(config, dataset, folder / f"seed_{seed}", seed, str(device))
            judge(config, folder / f"seed_{seed}", str(device))
    print(f"\n{row_text(report(config, dataset, folder, seeds))}\nwritten: {folder}")


def check_lerobot() -> None:
    """Raise ``ValueError`` where the packages of LeRobot's training are missing."""
    from importlib.util import find_spec

    if missing := [name for name in ("accelerate", "diffusers") if find_spec(name) is None]:
        raise ValueError(f"LeRobot's training needs {' and '.join(missing)}: uv pip install -e '.[lerobot]'")


def train(config: Config, dataset: str | Path, folder: Path, seed: int, device: str) -> None:
    """Run or resume ``lerobot-train``, whose output is appended to ``lerobot.log``."""
    import shutil

    from dynmap_rl.data.format.reading import find_dataset, read_info, read_split
    from dynmap_rl.utils.processes import run_script

    output, root = folder.absolute() / "lerobot", find_dataset(dataset).absolute()
    settings = output / TRAINED / "train_config.json"
    if settings.exists():
        # The stored paths are those of before the run or the dataset was moved.
        places = [f"--output_dir={output}", f"--dataset.root={root}"]
        arguments = [f"--config_path={settings}", "--resume=true", f"--policy.device={device}", *places]
    else:
        shutil.rmtree(output, ignore_errors=True)  # of a run without a checkpoint
        arguments = [
            f"--policy.type={config.policy}", f"--policy.device={device}", "--policy.push_to_hub=false",
            "--policy.pretrained_backbone_weights=null", *([] if config.full_size else OPTIONS[config.policy]),
            "--dataset.repo_id=local/demonstrations", f"--dataset.root={root}",
            f"--dataset.episodes={list(read_split(root, read_info(root), 'train'))}",
            "--dataset.use_imagenet_stats=false", f"--batch_size={config.batch}",
            *(["--num_workers=0"] if device == "cpu" else []),  # a GPU would wait for the frames
            f"--steps={config.steps}", f"--save_freq={min(config.steps, 500)}", "--env_eval_freq=0",
            f"--seed={seed}", f"--output_dir={output}",
        ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "lerobot.log"
    print(f"seed {seed}: lerobot-train, see {log}", flush=True)
    script, threads = Path(sys.executable).with_name("lerobot-train"), config.compute.threads
    if run_script(script, arguments, Path.cwd(), log, threads):
        last = (log.read_text(errors="replace").splitlines() or ["no output"])[-1]
        raise ValueError(f"lerobot-train failed; see {log}, which ends with: {last}")


def judge(config: Config, folder: Path, device: str) -> None:
    """Evaluate the policy of a seed."""
    from dynmap_rl.evaluation.protocol import evaluate
    from dynmap_rl.utils.files import write_json

    write_json(folder / "eval.json", evaluate(load(config, folder, device), config.task, config.eval))


def load(config: Config, folder: Path, device: str):
    """Load the policy of a seed as an actor."""
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.integrations.lerobot import LeRobotActor

    return LeRobotActor(folder / "lerobot" / TRAINED, device, get_task(config.task))


def report(config: Config, dataset: str | Path, folder: Path, seeds: list[int]) -> dict:
    """Collect the results of all seeds and write an animation, ``report.html`` and ``eval.json``."""
    from dynmap_rl.evaluation.protocol import unpack_rows
    from dynmap_rl.evaluation.statistics import shared_interval, summarize
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.reporting.media import film_policy
    from dynmap_rl.reporting.run_page import read_results, row_text
    from dynmap_rl.runs.folder import plain_settings
    from dynmap_rl.utils.devices import device_name
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit

    results = read_results(folder, seeds, None)
    rows = [unpack_rows(result["test"]["rows"]) for result in results]
    intervals = {"SR_interval": shared_interval(rows), "DR_interval": shared_interval(rows, "dropped")}
    command, settings = command_line(sys.argv), plain_settings(config)
    result = {
        "row": ROWS[config.policy],
        "policy": "LeRobot",
        "task": config.task,
        "trained_on": {"dataset": str(dataset)},
        "world_model": {"task": config.task, "training": "lerobot"},
        "seeds": list(seeds),
        "test_protocol": summarize([row for part in rows for row in part]) | intervals,
        "settings": settings,
        "command": command,
        "commit": find_commit(),
        "device": device_name(config.compute.device),
        "results": results,
    }
    actor = load(config, folder / f"seed_{seeds[0]}", "cpu")
    film_policy(actor, config.task, results[0]["test"]["rows"], folder / "rollouts.gif")
    write_html(folder, f"{result['row']}, {config.task}", row_text(result), command, settings)
    write_json(folder / "eval.json", result)  # last: it marks the run as complete
    return result


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
