"""Train a state-based PPO expert (paper, Sec. IV-C).

    python recipes/expert.py --task balance_reaching

Writes a run folder with ``metrics.jsonl`` and a checkpoint every ``checkpoint_every`` iterations. The same command
on the same folder resumes. To ship checkpoints with the package, copy them to ``dynmap_rl/experts/checkpoints``.
"""

import time
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.runs import run_recipe


@dataclass
class Config:
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Run folder; by default runs/expert/TASK.
    run: Path | None = None
    seed: int = 0
    # Worlds stepped together; each iteration runs one episode's length in all of them.
    num_envs: int = 64
    iterations: int = 45
    # Passes over each iteration's frames.
    epochs: int = 10
    minibatch: int = 1024
    learning_rate: float = 5e-4
    gamma: float = 0.97
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 1e-3
    # Iterations between checkpoints.
    checkpoint_every: int = 5
    # Fresh scenes on which each checkpoint is judged, with the policy's mean.
    eval_episodes: int = 200
    # Fresh scenes for the last checkpoint.
    final_episodes: int = 1000
    threads: int = 2


def main(config: Config) -> None:
    import torch
    from torchrl.collectors import Collector
    from torchrl.modules import MLP, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE
    from tqdm import tqdm

    from dynmap_rl import runs
    from dynmap_rl.envs import DynmapBatchedEnv
    from dynmap_rl.envs.world import ACCELERATION_LIMIT, EPISODE_STEPS
    from dynmap_rl.experts import ExpertNetwork, make_actor

    torch.set_num_threads(config.threads)
    env = DynmapBatchedEnv(config.task, config.num_envs, control="acceleration")
    folder = runs.open_run(
        config.run or Path("runs/expert") / env.task.name, config, ignore=("iterations", "threads")
    )
    runs.seed_everything(config.seed)
    state_size = env.task.state_size
    network = ExpertNetwork(state_size, tuple(ACCELERATION_LIMIT))
    actor = make_actor(network)
    critic = ValueOperator(
        MLP(state_size, 1, num_cells=[128, 128], activation_class=torch.nn.Tanh), in_keys=["state"]
    )
    advantage = GAE(
        gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, average_gae=True, shifted=True
    )
    loss_module = ClipPPOLoss(
        actor, critic, clip_epsilon=config.clip, entropy_coeff=config.entropy, critic_coeff=1.0
    )
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=config.learning_rate, eps=1e-5)

    start, seconds = 0, 0.0
    state_path = folder / "checkpoint" / "training_state.pt"
    if state := runs.load_training_state(state_path):
        loss_module.load_state_dict(state["loss_module"])
        optimizer.load_state_dict(state["optimizer"])
        start, seconds = state["iteration"], state["seconds"]
    runs.truncate_metrics(folder, start)

    # Every iteration starts from fresh, seeded scenes, so that a resumed run equals an uninterrupted one.
    frames = config.num_envs * EPISODE_STEPS
    collector = Collector(
        env,
        actor,
        frames_per_batch=frames,
        total_frames=-1,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)
    progress = tqdm(range(start, config.iterations), initial=start, total=config.iterations, unit="iteration")
    for iteration in progress:
        began = time.perf_counter()
        runs.seed_everything(config.seed + 1000 * (iteration + 1))
        env.set_seed(config.seed + 1000 * (iteration + 1))
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 - 0.9 * iteration / config.iterations)
        batch = next(batches)
        losses = update(batch, loss_module, advantage, optimizer, config)
        done = batch["next", "done"].squeeze(-1)
        seconds += time.perf_counter() - began
        metrics = {
            "frames": (iteration + 1) * frames,
            "seconds": seconds,
            "reward": batch["next", "reward"].mean(),
            "success": batch["next", "is_success"].squeeze(-1)[done].float().mean(),
            "drop": batch["next", "dropped"].squeeze(-1)[done].float().mean(),
            **losses,
        }
        runs.append_metrics(folder, iteration + 1, **metrics)
        progress.set_postfix(success=f"{metrics['success']:.2f}", drop=f"{metrics['drop']:.2f}")
        last = iteration + 1 == config.iterations
        if last or (iteration + 1) % config.checkpoint_every == 0:
            episodes = config.final_episodes if last else config.eval_episodes
            facts = evaluate(network, env.task, episodes)
            facts |= {
                "task": config.task,
                "iteration": iteration + 1,
                "frames": metrics["frames"],
                "seconds": round(seconds, 1),
                "state_size": state_size,
                "acceleration_limit": ACCELERATION_LIMIT.tolist(),
                "hidden": 128,
            }
            path = folder / "checkpoint" / f"iteration_{iteration + 1:03d}"
            runs.save_weights(path.with_suffix(".safetensors"), network)
            runs.write_json(path.with_suffix(".json"), facts)
            progress.write(
                f"iteration {iteration + 1}: success {facts['success']:.1%}, drop {facts['drop']:.1%}"
            )
        runs.save_training_state(
            state_path,
            loss_module=loss_module.state_dict(),
            optimizer=optimizer.state_dict(),
            iteration=iteration + 1,
            seconds=seconds,
        )
    collector.shutdown()
    print(f"done: {folder}")


def update(batch, loss_module, advantage, optimizer, config: Config) -> dict[str, float]:
    """PPO's epochs of minibatches over one batch ``[N, T]``."""
    import torch

    with torch.no_grad():
        batch = advantage(batch)
    batch = batch.select(
        "state", "action", "action_log_prob", "loc", "scale", "advantage", "value_target", "state_value"
    ).reshape(-1)
    for _ in range(config.epochs):
        for index in torch.randperm(len(batch)).split(config.minibatch):
            losses = loss_module(batch[index])
            loss = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(loss_module.parameters(), 0.5)
            optimizer.step()
    return {k: losses[k].item() for k in ("loss_objective", "loss_critic", "entropy")}


def evaluate(network, task, episodes: int) -> dict[str, float]:
    """Success and drop rate of the mean action on fresh scenes (the exploration split, never evaluated on)."""
    from dynmap_rl.envs import scene_seed
    from dynmap_rl.experts import roll_out

    worlds = roll_out(network, task, [scene_seed("exploration", 10_000_000 + i) for i in range(episodes)])
    return {
        "success": sum(task.is_success(world) for world in worlds) / episodes,
        "drop": sum(world.dropped for world in worlds) / episodes,
        "position_error": sum(world.position_error for world in worlds) / episodes,
        "episodes": episodes,
    }


if __name__ == "__main__":
    run_recipe(main, Config)
