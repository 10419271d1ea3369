"""Evaluate a policy or an expert on a task's test scenes.

    python recipes/evaluate.py --policy balance_reaching                             # ships with the package
    python recipes/evaluate.py --policy runs/decoupled/balance_reaching/position_velocity_recurrent --failures
    python recipes/evaluate.py --policy runs/act/checkpoints/last/pretrained_model   # any LeRobot policy
    python recipes/evaluate.py --policy balance_reaching --delay 6 --jitter 2 --lost 0.1     # late and lost frames
    python recipes/evaluate.py --expert balance_reaching --task balance_reaching_obstacle
    python recipes/evaluate.py --expert careless                                     # ignores the block

A policy acts on frames in closed loop; the result is drop rate, position error, success rate, and the number of failures
by cause. An expert acts on states; the result is the rates of success, drops and touches, and for task 2 how often the
straight path to the goal is blocked. Rates have 95 % Wilson intervals. runs/evaluate gets numbers and a page.
"""

import sys
from dataclasses import asdict, astuple, dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.devices import Compute


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Policy: a run folder, balance_reaching (shipped), a LeRobot pretrained_model folder, or a hub id of either.
    policy: str | None = None
    # Load a LeRobot policy from the hub, whose files may name code that is then run.
    trust_remote_code: bool = False
    # Seed of the run's policy.
    seed: int = 0
    # Task, such as mujoco:FetchPush, or module:Class of your own; by default that of the run, else balance_reaching.
    task: str | None = None
    # Delay of the frames in control steps. The world model imagines the steps up to the present.
    delay: int = 0
    # Largest deviation from --delay, in control steps; frames then arrive out of order and in bursts.
    jitter: int = 0
    # Probability that a frame is lost.
    lost: float = 0.0
    # Error of the delays that the policy is told, in control steps.
    delay_error: int = 0
    # Act on the newest frame that has arrived as if it were of the present, for comparison.
    stale: bool = False
    # Expert: task of a shipped expert, folder of checkpoints, or careless (ignores the block); by default the task's own.
    expert: str | None = None
    # Checkpoint of the expert; by default the last.
    checkpoint: str | None = None
    # Evaluation in closed loop, here without the paper's protocol.
    eval: Evaluation = Evaluation(paper_episodes=0)
    # Film failed episodes alone, where there are any.
    failures: bool = False
    # Device, with --policy, and cores.
    compute: Compute = Compute()
    # Another JSON file of the result, besides eval.json beside the page.
    output: Path | None = None


def main(config: Config) -> None:
    """Evaluate and report."""
    import torch

    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import plain_settings
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit

    refuse(config.eval, Evaluation(paper_episodes=0), ["paper_episodes"], "recipes/evaluate.py", "eval.")
    if config.policy:
        refuse(config, Config(), ["expert", "checkpoint"], "--policy")
    else:
        of_frames = "delay", "jitter", "lost", "delay_error", "stale"
        refuse(config, Config(), ["seed", "trust_remote_code", *of_frames], "an expert")
        refuse(config.compute, Compute(), ["device"], "an expert", "compute.")
    torch.set_num_threads(1)  # networks are small, and threads would wait for each other
    folder, text, result, draw = (judge_policy if config.policy else judge_expert)(config)
    print(text)
    who = f"Policy {config.policy}" if config.policy else f"Expert {result['expert']}"
    command = command_line(sys.argv)
    result |= {"split": config.eval.split, "episodes": config.eval.episodes, "command": command}
    for output in dict.fromkeys([folder / "eval.json", config.output or folder / "eval.json"]):
        write_json(output, result | {"commit": find_commit()})
    draw(path=folder / "rollouts.gif")
    page = write_html(folder, f"{who}, {result['task']}", text, command, plain_settings(config))
    print(f"written: {output}, {page}")


def name_folder(config: Config, *names: str) -> Path:
    """Return the folder of an evaluation, another one for each number of episodes."""
    few = [] if (n := config.eval.episodes) == Evaluation.episodes else [f"{n}_episodes"]
    return Path("runs/evaluate") / "_".join([*names, config.eval.split, *few]).replace("/", "")[-255:]


def judge_policy(config: Config) -> tuple:
    """Return the folder, the numbers as text, the result with the outcome of every episode, and what draws a film."""
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.protocol import evaluate
    from dynmap_rl.evaluation.statistics import summary_text
    from dynmap_rl.modules.actor import Actor
    from dynmap_rl.modules.delayed_actor import DelayedActor
    from dynmap_rl.reporting.media import film_policy
    from dynmap_rl.runs.lookup import find_run, task_of_run

    delay, folder = read_delay(config), find_run(config.policy)
    task = config.task or task_of_run(folder) or "balance_reaching"
    actor = load_policy(config, folder, get_task(task, from_file=not config.task))
    if delay and not config.stale:
        if not isinstance(actor, Actor):
            raise ValueError("--policy must be a run for --delay; add --stale for a LeRobot policy")
        actor = DelayedActor(actor, max_delay=delay.longest)
    own = isinstance(actor, Actor | DelayedActor)
    parts = [*Path(config.policy).parts, *([f"seed_{config.seed}"] if own else [])]
    parts += ["_".join(map(str, ["delay", *astuple(delay)])), *["stale"] * config.stale] if delay else []
    late = {"delay": asdict(delay), "stale": config.stale} if delay else {}
    folder = name_folder(config, get_task(task).name, *parts)
    folder.mkdir(parents=True, exist_ok=True)  # errors come before the evaluation
    result = evaluate(actor, task, config.eval, delay, workers=config.compute.threads if own else 1)["test"]
    draw = partial(film_policy, actor, task, result["rows"], delay=delay, failures=config.failures)
    result = {"task": task, "policy": config.policy, **result, **late}
    return folder, summary_text(result["summary"]), result, draw


def read_delay(config: Config):
    """Return the delay of the frames, or None without one."""
    from dynmap_rl.envs.delay import FrameDelay

    delay = FrameDelay(config.delay, config.jitter, config.lost, config.delay_error)
    if config.stale:
        refuse(config, Config(), ["delay_error"], "--stale, which does not read delays")
    return delay if delay != FrameDelay() else refuse(config, Config(), ["stale"], "frames in time")


def load_policy(config: Config, folder: Path, task):
    """Load the actor of a run, or a LeRobot policy, which gets the task's description as an instruction."""
    import torch

    from dynmap_rl.runs.lookup import has_world_model, load_actor
    from dynmap_rl.utils.devices import choose_device

    if not folder.exists():
        raise ValueError(f"--policy must be a run or a policy, got {config.policy}; see recipes/README.md")
    if has_world_model(folder):
        refuse(config, Config(), ["trust_remote_code"], "a run")
        return load_actor(folder, config.seed).to(choose_device(config.compute.device))
    path = Path(config.policy).expanduser()
    if path.exists():
        refuse(config, Config(), ["trust_remote_code"], "a policy on this machine")
    elif not config.trust_remote_code:
        raise ValueError(
            f"{config.policy} on the hub may name code to run; add --trust_remote_code to allow it"
        )
    try:
        from dynmap_rl.integrations.lerobot import LeRobotActor
    except ImportError as error:
        raise ValueError(
            f"--policy must be a run, got {config.policy}; LeRobot policies need uv pip install -e '.[lerobot]' ({error})"
        ) from error
    refuse(config, Config(), ["seed"], "a LeRobot policy")
    torch.set_num_threads(config.compute.threads)
    return LeRobotActor(str(path), choose_device(config.compute.device), task)


def judge_expert(config: Config) -> tuple:
    """Return folder, text, result and film as for a policy; the result has ``rates``, ``intervals`` (%) and ``rows``."""
    from dynmap_rl.envs.scene import scene_seeds
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.experts import judge_demonstrator, list_outcomes, summarize_outcomes
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.experts.careless import CarelessController
    from dynmap_rl.experts.network import list_checkpoints, load_expert, play_to_end, task_of_expert
    from dynmap_rl.reporting.media import film, film_demonstrator

    task = get_task(config.task or "balance_reaching")
    expert, seeds = config.expert or task.name, scene_seeds(config.eval.split, config.eval.episodes)
    if task.has_demonstrator:
        refuse(config, Config(), ["expert", "checkpoint"], f"{config.task}, which has an expert of its own")
        expert, checkpoint = "scripted", "demonstrator"
        outcomes, draw = judge_demonstrator(task, seeds), partial(film_demonstrator, config.task)
    else:
        if expert == "careless":
            refuse(config, Config(), ["checkpoint"], "--expert careless")
            checkpoint, network, trained_on = "baseline", CarelessController(task), task
        else:
            checkpoint = config.checkpoint or list_checkpoints(expert)[-1]
            network, trained_on = load_expert(expert, checkpoint), task_of_expert(expert, task)
        outcomes = list_outcomes(task, play_to_end(network, task, seeds, states=trained_on))
        draw = partial(film, network, task, states=trained_on)
    folder = name_folder(config, task.name, *Path(expert).parts[-4:], checkpoint)
    draw = partial(draw, failures_first(seeds, outcomes["success"], alone=config.failures))
    text, numbers = summarize_outcomes(outcomes)
    result = {"task": config.task or task.name, "expert": expert, "checkpoint": checkpoint, **numbers}
    return folder, text, result, draw


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv, stopped="repeat the command")
