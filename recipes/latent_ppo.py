"""Train PPO on the latents of a frozen world model, and compare it with PPO on states.

    python recipes/latent_ppo.py --pretrained runs/decoupled/balance_reaching/position_velocity_recurrent

The policy reads latent, hidden states and goal, as imitating policies do, where the expert of ``recipes/expert.py``
reads the simulator's state. Network, actions (accelerations) and algorithm are the same, and both are judged on the same
scenes. Acceleration limit and length of training differ: this recipe has the full acceleration and 90 iterations, the shipped
experts of tasks 1 and 2 have a quarter of it, and 40 and 60 iterations. The same command resumes a stopped run, and prints the
result of a finished one.
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

    # Run whose world model is used: a folder, a hub id, or balance_reaching (shipped). Required.
    pretrained: str | None = None
    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Checkpoint folder of the expert to compare with; by default the shipped one of the task.
    expert: str | None = None
    # Run folder; by default runs/latent_ppo/TASK.
    run: Path | None = None
    # Training.
    ppo: PPOTraining = PPOTraining(iterations=90)
    # Width of the network's hidden layers.
    hidden: int = 128
    # Threads of torch, and processes that roll worlds out.
    threads: int = 2
    # Logger beside metrics.jsonl: tensorboard, wandb or trackio.
    logger: str | None = None


def main(config: Config) -> None:
    """Train, judge and report."""
    import torch

    from dynmap_rl.envs.task import Task
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.envs.world import ACCELERATION_LIMIT
    from dynmap_rl.evaluation.experts import fresh_scenes, rates
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.experts import network as experts
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import open_run, plain_settings
    from dynmap_rl.runs.loggers import check_logger
    from dynmap_rl.runs.lookup import check_actions, load_world_model_of
    from dynmap_rl.training.decoupled import check_same
    from dynmap_rl.training.ppo import train_ppo
    from dynmap_rl.utils.devices import seed_everything
    from dynmap_rl.utils.files import read_json, write_json
    from dynmap_rl.utils.version import find_commit
    from dynmap_rl.utils.weights import fingerprint

    if config.pretrained is None:
        raise ValueError("--pretrained must be a run with a world model; train one with recipes/decoupled.py")
    if config.threads < 1 or config.hidden < 1:
        raise ValueError("--threads and --hidden must be at least 1")
    check_logger(config.logger)
    task, ppo = get_task(config.task, kind=Task), config.ppo
    world_model, origin = load_world_model_of(config.pretrained)
    check_actions(world_model, origin, task, config.pretrained)
    world_model.requires_grad_(False)
    expert = experts.load_expert(config.expert or config.task)
    states_of = experts.task_of_expert(config.expert or config.task, task)
    folder = config.run or Path("runs/latent_ppo") / task.name
    open_run(folder, config, ignore=("run", "threads", "logger"))
    frozen_weights, begun = fingerprint(world_model), folder / "world_model.json"
    if not begun.exists():
        write_json(begun, {"world_model_sha256": frozen_weights})
    check_same(world_model, read_json(begun), folder)
    if (folder / "eval.json").exists():
        result = read_json(folder / "eval.json")
        print(f"{folder} is complete; delete it to run again\n{result_text(result)}")
        return
    torch.set_num_threads(config.threads)

    make = partial(make_env, world_model, config.task)
    size = make(1).observation_spec["state"].shape[-1]
    seed_everything(ppo.seed)
    network = experts.ExpertNetwork(size, tuple(ACCELERATION_LIMIT), config.hidden)

    def judge(episodes: int) -> dict[str, float]:
        return rates(task, roll_out(network, world_model, config.task, fresh_scenes(episodes)))

    facts = {"task": config.task, "state_size": size, "hidden": config.hidden}
    facts["acceleration_limit"] = ACCELERATION_LIMIT.tolist()
    common = {"threads": config.threads, "logger": config.logger}
    train_ppo(make, network, folder, ppo, judge=judge, facts=facts, **common)
    if fingerprint(world_model) != frozen_weights:
        raise ValueError("the frozen world model has changed; this run is not valid")
    states = rates(task, experts.play_to_end(expert, task, fresh_scenes(ppo.final_episodes), states_of))
    result = {
        "task": config.task,
        "world_model_of": origin,
        "supervision": list(world_model.supervision),
        "world_model_sha256": frozen_weights,
        "latents": read_json(folder / "checkpoint" / f"iteration_{ppo.iterations:03d}.json"),
        "states": states | {"expert": config.expert or config.task},
        "command": command_line(sys.argv),
        "commit": find_commit(),
    }
    seeds = fresh_scenes(ppo.eval_episodes)
    success = [task.is_success(world) for world in roll_out(network, world_model, config.task, seeds)]
    film(network, world_model, config.task, failures_first(seeds, success), folder / "rollouts.gif")
    settings = plain_settings(config)
    write_html(folder, f"PPO on latents, {task.name}", result_text(result), result["command"], settings)
    write_json(folder / "eval.json", result)
    print(f"{result_text(result)}\nwritten: {folder}")


def make_env(world_model, task: str, num_envs: int, keep_pixels: bool = False):
    """Make an environment whose ``state`` is latent, hidden states and goal; frames are kept on request."""
    from torchrl.envs import CatTensors, Compose, ExcludeTransform, TransformedEnv

    from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
    from dynmap_rl.envs.world_model_transform import WorldModelTransform

    env = DynmapBatchedEnv(task, num_envs, from_pixels=True, control="acceleration", include_state=False)
    states = CatTensors(["latent", "hidden1", "hidden2", "goal"], "state", del_keys=False, sort=False)
    transform = WorldModelTransform(world_model, agent_pos="agent_pos", mixed=True)
    rest = [] if keep_pixels else [ExcludeTransform("pixels")]
    return TransformedEnv(env, Compose(transform, states, *rest))


def play(env, network, seeds: list[int]):
    """Yield the observations of every step, one episode a scene seed, of the network's mean action."""
    import torch

    from dynmap_rl.envs.world import EPISODE_STEPS

    with torch.no_grad():
        td = env.reset(scene_seed=torch.tensor(seeds))
        for _ in range(EPISODE_STEPS):
            yield td
            td = env.step(td.set("action", network(td["state"])[0]))["next"]


def roll_out(network, world_model, task: str, seeds: list[int]) -> list:
    """Play to the end and return the worlds."""
    env = make_env(world_model, task, len(seeds))
    for _ in play(env, network, seeds):
        pass
    return env.base_env.worlds


def film(network, world_model, task: str, seeds: list[int], path: Path) -> None:
    """Write episodes as an animation."""
    import torch

    from dynmap_rl.reporting.media import save_gif

    env = make_env(world_model, task, len(seeds), keep_pixels=True)
    pixels = torch.stack([td["pixels"] for td in play(env, network, seeds)], 1)
    save_gif(pixels, path, env.base_env.layout.dt)


def result_text(result: dict) -> str:
    """Return the rates of both policies as text."""
    from dynmap_rl.evaluation.experts import rates_text

    return "\n".join(f"PPO on {name:8} {rates_text(result[name])}" for name in ("latents", "states"))


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
