"""Train PPO on the latents of a frozen world model, and compare it with PPO on states.

    python recipes/latent_ppo.py --world_model runs/decoupled/balance_reaching/position_velocity_recurrent

The policy reads latent, hidden states and goal, what imitating policies read, where the expert of
``recipes/expert.py`` reads the simulator's state; all else is the same: network, actions (accelerations), algorithm and
settings. Both are judged on the same fresh scenes. The same command on the same folder goes on where it was stopped, or
says that it is done.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import check_at_least_one
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.cli import replace_defaults
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Run folder whose world model is taken, its id on the hub, or balance_reaching, which ships with the package; of
    # another task too. Must be given.
    world_model: Path | None = None
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Folder of the checkpoints of the expert to compare with; by default the one that ships for the task.
    expert: str | None = None
    # Run folder; by default runs/latent_ppo/TASK.
    run: Path | None = None
    # Seed of everything random.
    seed: int = 0
    # Worlds stepped together; each iteration runs one episode's length in all of them.
    num_envs: int = 64
    # Iterations: rollouts and the updates from them.
    iterations: int = 90
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
    # Width of the network's hidden layers.
    hidden: int = 128
    # Iterations between checkpoints.
    checkpoint_every: int = 10
    # Fresh scenes on which each checkpoint is judged, with the policy's mean.
    eval_episodes: int = 200
    # Fresh scenes for the last checkpoint, and for the expert.
    final_episodes: int = 1000
    # Every stage in a minimal size, for tests.
    smoke: bool = False
    # Torch's threads.
    threads: int = 2
    # Metrics to tensorboard, wandb or trackio as well, where it is installed.
    logger: str | None = None


SMOKE = {
    "num_envs": 4, "iterations": 2, "epochs": 1, "minibatch": 240, "checkpoint_every": 1, "eval_episodes": 3,
    "final_episodes": 4, "hidden": 16,
}  # fmt: skip


def main(config: Config) -> None:
    import torch

    from dynmap_rl import experts  # MODULE
    from dynmap_rl import frozen  # MODULE
    from dynmap_rl import runs  # MODULE
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.envs.world import ACCELERATION_LIMIT
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.training.ppo import POSITIVE
    from dynmap_rl.evaluation.experts import fresh_scenes
    from dynmap_rl.evaluation.experts import rates
    from dynmap_rl.training.ppo import train_ppo
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.utils.weights import fingerprint

    if config.smoke:
        replace_defaults(config, SMOKE)
    if config.world_model is None:
        raise ValueError(
            "--world_model is the run folder of a world model; train one with recipes/decoupled.py"
        )
    check_logger(config.logger)
    check_at_least_one(config, *POSITIVE)
    task = get_task(config.task)
    world_model, source = frozen.load_source(config.world_model)
    world_model.requires_grad_(False)
    expert = experts.load_expert(config.expert or config.task)
    sees = experts.task_of_expert(config.expert or config.task, task)
    folder = config.run or Path("runs/latent_ppo") / f"{task.name}{'_smoke' if config.smoke else ''}"
    folder = runs.open_run(folder, config, ignore=("run", "threads", "logger"))
    if (folder / "eval.json").exists():
        print(f"{folder} is done; delete it to run again")
        return print(result_text(runs.read_json(folder / "eval.json")))
    torch.set_num_threads(config.threads)

    frozen_weights = fingerprint(world_model)
    env = make_env(world_model, config.task, config.num_envs)
    size = env.observation_spec["state"].shape[-1]
    runs.seed_everything(config.seed)
    network = experts.ExpertNetwork(size, tuple(ACCELERATION_LIMIT), config.hidden)

    def judge(episodes: int) -> dict[str, float]:
        return rates(task, roll_out(network, world_model, config.task, fresh_scenes(episodes)))

    facts = {"task": config.task, "state_size": size, "hidden": config.hidden}
    facts["acceleration_limit"] = ACCELERATION_LIMIT.tolist()
    train_ppo(env, network, folder, config, judge, facts)
    if fingerprint(world_model) != frozen_weights:
        raise ValueError("the frozen world model has changed; this run is not valid")
    states = rates(task, experts.roll_out(expert, task, fresh_scenes(config.final_episodes), sees))
    result = {
        "task": config.task,
        "world_model_of": source,
        "supervision": list(world_model.supervision),
        "world_model_sha256": frozen_weights,
        "latents": runs.read_json(folder / "checkpoint" / f"iteration_{config.iterations:03d}.json"),
        "states": states | {"expert": config.expert or config.task},
        "command": command_line(),
    }
    seeds = fresh_scenes(config.eval_episodes)
    success = [task.is_success(world) for world in roll_out(network, world_model, config.task, seeds)]
    film(network, world_model, config.task, failures_first(seeds, success), folder / "rollouts.gif")
    write_html(folder, f"PPO on latents, {task.name}", result_text(result), result["command"])
    runs.write_json(folder / "eval.json", result)
    print(result_text(result))


def make_env(world_model, task: str, num_envs: int, keep_pixels: bool = False):
    """``state`` is what the world model makes of the frames, and the goal; frames themselves are kept if asked for."""
    from torchrl.envs import CatTensors, Compose, ExcludeTransform, TransformedEnv

    from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
    from dynmap_rl.envs.world_model_transform import WorldModelTransform

    env = DynmapBatchedEnv(task, num_envs, from_pixels=True, control="acceleration", pixels_only=True)
    states = CatTensors(["latent", "hidden1", "hidden2", "goal"], "state", del_keys=False, sort=False)
    transform = WorldModelTransform(world_model, agent_pos="agent_pos", mixed=True)
    rest = [] if keep_pixels else [ExcludeTransform("pixels")]
    return TransformedEnv(env, Compose(transform, states, *rest))


def play(env, network, seeds: list[int]):
    """What is observed in each of the 120 steps of the mean action's episodes, one a scene seed."""
    import torch

    from dynmap_rl.envs.world import EPISODE_STEPS

    with torch.no_grad():
        td = env.reset(scene_seed=torch.tensor(seeds))
        for _ in range(EPISODE_STEPS):
            yield td
            td = env.step(td.set("action", network(td["state"])[0]))["next"]


def roll_out(network, world_model, task: str, seeds: list[int]) -> list:
    """:func:`play` to the end: the worlds as they are then."""
    env = make_env(world_model, task, len(seeds))
    for _ in play(env, network, seeds):
        pass
    return env.base_env.worlds


def film(network, world_model, task: str, seeds: list[int], path: Path) -> None:
    """:func:`play` as an animation."""
    import torch

    from dynmap_rl.reporting.media import save_gif

    env = make_env(world_model, task, len(seeds), keep_pixels=True)
    save_gif(torch.stack([td["pixels"] for td in play(env, network, seeds)], 1), path)


def result_text(result: dict) -> str:
    from dynmap_rl.evaluation.experts import rates_text

    return "\n".join(f"PPO on {name:8} {rates_text(result[name])}" for name in ("latents", "states"))


if __name__ == "__main__":
    run_recipe(main, Config)
