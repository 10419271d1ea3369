"""Train a state-based PPO expert (paper, Sec. IV-C).

    python recipes/expert.py --task balance_reaching

Writes a run folder with ``metrics.jsonl`` and a checkpoint every ``ppo.checkpoint_every`` iterations. The same command
resumes a stopped run. To ship checkpoints with the package, copy them to ``dynmap_rl/experts/checkpoints``.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.training.settings import PPOTraining
from dynmap_rl.utils.cli import command_line, run_recipe


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Run folder; by default runs/expert/TASK.
    run: Path | None = None
    # Largest acceleration of the expert, as a share of the cart's limits. Blocks tip at half of them or more, and a policy
    # that imitates needs a margin. The shipped experts have 0.25 on tasks 1 and 2, and 1 on task 3.
    acceleration: float = 0.25
    # Training.
    ppo: PPOTraining = PPOTraining()
    # Processes that roll worlds out. With two or more, actor and critic learn at the same time. The result is the same.
    threads: int = 2
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None


def main(config: Config) -> None:
    """Train, judge and report."""
    import torch

    from dynmap_rl.envs.task import Task
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
    from dynmap_rl.envs.world import ACCELERATION_LIMIT
    from dynmap_rl.evaluation.experts import fresh_scenes, rates, rates_text
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.experts.network import ExpertNetwork, list_checkpoints, play_to_end
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.reporting.media import film
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.training.ppo import train_ppo
    from dynmap_rl.utils.devices import seed_everything
    from dynmap_rl.utils.files import read_json

    if not 0 < config.acceleration <= 1:
        raise ValueError(f"--acceleration must be above 0 and at most 1, got {config.acceleration}")
    if config.threads < 1:
        raise ValueError(f"--threads must be at least 1, got {config.threads}")
    check_logger(config.logger)
    ppo = config.ppo
    torch.set_num_threads(1)  # these networks are too small for more
    task = get_task(config.task, kind=Task)
    make_env = partial(DynmapBatchedEnv, config.task, control="acceleration")
    folder = config.run or Path("runs/expert") / task.name
    # A run may resume with more iterations.
    open_run(folder, config, ignore=("run", "threads", "logger", "ppo.iterations"))
    seed_everything(ppo.seed)
    limit = config.acceleration * ACCELERATION_LIMIT
    network = ExpertNetwork(task.state_size, tuple(limit))

    def judge(episodes: int) -> dict[str, float]:
        return rates(task, play_to_end(network, task, fresh_scenes(episodes)))

    facts = {
        "task": config.task,
        "state_size": task.state_size,
        "acceleration_limit": limit.tolist(),
        "hidden": 128,
    }
    common = {"threads": config.threads, "logger": config.logger}
    train_ppo(make_env, network, folder, ppo, judge=judge, facts=facts, **common)
    last = read_json(folder / "checkpoint" / f"{list_checkpoints(folder / 'checkpoint')[-1]}.json")
    seeds = fresh_scenes(ppo.eval_episodes)
    success = [task.is_success(world) for world in play_to_end(network, task, seeds)]
    film(network, task, failures_first(seeds, success), folder / "rollouts.gif")
    settings = plain_settings(config)
    write_html(folder, f"Expert, {task.name}", rates_text(last), command_line(sys.argv), settings)
    print(f"{rates_text(last)}\nwritten: {folder}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
