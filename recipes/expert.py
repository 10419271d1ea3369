"""Train a state-based PPO expert (paper, Sec. IV-C).

    python recipes/expert.py --task balance_reaching

Writes a run folder with ``metrics.jsonl`` and a checkpoint every ``checkpoint_every`` iterations. The same command
on the same folder resumes. To ship checkpoints with the package, copy them to ``dynmap_rl/experts/checkpoints``.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import check_at_least_one
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Run folder; by default runs/expert/TASK.
    run: Path | None = None
    # Seed of everything random.
    seed: int = 0
    # Worlds stepped together; each iteration runs one episode's length in all of them.
    num_envs: int = 64
    # Iterations: rollouts and the updates from them.
    iterations: int = 45
    # Passes over each iteration's frames.
    epochs: int = 10
    # Frames an optimiser step.
    minibatch: int = 1024
    # Learning rate at first; it falls to a tenth.
    learning_rate: float = 5e-4
    # Discount of a step.
    gamma: float = 0.97
    # Lambda of the generalised advantage estimates.
    gae_lambda: float = 0.95
    # Limit of PPO's ratio.
    clip: float = 0.2
    # Weight of the entropy.
    entropy: float = 1e-3
    # Iterations between checkpoints.
    checkpoint_every: int = 5
    # Fresh scenes on which each checkpoint is judged, with the policy's mean.
    eval_episodes: int = 200
    # Fresh scenes for the last checkpoint.
    final_episodes: int = 1000
    # Threads that simulate, and in which the two networks learn; they change no bit.
    threads: int = 2
    # Metrics to tensorboard, wandb or trackio as well, where it is installed.
    logger: str | None = None


def main(config: Config) -> None:
    import torch

    from dynmap_rl import runs  # MODULE
    from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
    from dynmap_rl.envs.world import ACCELERATION_LIMIT
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.experts.network import ExpertNetwork
    from dynmap_rl.reporting.media import film
    from dynmap_rl.experts.network import list_checkpoints
    from dynmap_rl.experts.network import roll_out
    from dynmap_rl.training.ppo import POSITIVE
    from dynmap_rl.evaluation.experts import fresh_scenes
    from dynmap_rl.evaluation.experts import rates
    from dynmap_rl.evaluation.experts import rates_text
    from dynmap_rl.training.ppo import train_ppo
    from dynmap_rl.runs.loggers import check_logger

    check_logger(config.logger)
    check_at_least_one(config, *POSITIVE)
    torch.set_num_threads(1)  # more take longer to wait for each other than these networks do to compute
    env = DynmapBatchedEnv(config.task, config.num_envs, control="acceleration", threads=config.threads)
    folder = runs.open_run(
        config.run or Path("runs/expert") / env.task.name,
        config,
        ignore=("run", "iterations", "threads", "logger"),
    )
    runs.seed_everything(config.seed)
    network = ExpertNetwork(env.task.state_size, tuple(ACCELERATION_LIMIT))

    def judge(episodes: int) -> dict[str, float]:
        return rates(env.task, roll_out(network, env.task, fresh_scenes(episodes)))

    facts = {
        "task": config.task,
        "state_size": env.task.state_size,
        "acceleration_limit": ACCELERATION_LIMIT.tolist(),
        "hidden": 128,
    }
    train_ppo(env, network, folder, config, judge, facts)
    last = runs.read_json(folder / "checkpoint" / f"{list_checkpoints(folder / 'checkpoint')[-1]}.json")
    seeds = fresh_scenes(config.eval_episodes)
    success = [env.task.is_success(world) for world in roll_out(network, env.task, seeds)]
    film(network, env.task, failures_first(seeds, success), folder / "rollouts.gif")
    write_html(folder, f"Expert, {env.task.name}", rates_text(last), command_line())
    print(f"{rates_text(last)}\ndone: {folder}")


if __name__ == "__main__":
    run_recipe(main, Config)
