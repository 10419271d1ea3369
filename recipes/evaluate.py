"""Judge a trained policy, or an expert, on a task's test scenes.

    python recipes/evaluate.py --policy balance_reaching                             # ships with the package
    python recipes/evaluate.py --policy runs/decoupled/balance_reaching/position_velocity_recurrent
    python recipes/evaluate.py --policy runs/act/checkpoints/last/pretrained_model   # any policy of LeRobot
    python recipes/evaluate.py --expert balance_reaching --task balance_reaching_obstacle

A policy sees frames and acts in closed loop: drop rate, position error and success rate, as in our tables. An expert,
by default the task's own, sees the state: success, drop and touch rates, for task 2 also how often the straight path
to the goal is blocked and how often the shortest way leads around the obstacle. Rates have 95 % Wilson intervals. A
folder of runs/evaluate keeps the numbers and a page with some of the episodes, failures first.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Run folder of ours, or balance_reaching, which ships with the package; or a pretrained_model folder of LeRobot. Both
    # may be on the Hugging Face hub, named by their id.
    policy: str | None = None
    # Load a policy of LeRobot from the hub: its files may name code that is then run. Run folders of ours cannot.
    trust_remote_code: bool = False
    # Which of a run's policies.
    seed: int = 0
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own; by
    # default the one that a run of ours was trained on, otherwise balance_reaching.
    task: str | None = None
    # Expert: the name of the task that it ships for, or a folder of checkpoints; by default the task's own.
    expert: str | None = None
    # Its checkpoint; by default the last.
    checkpoint: str | None = None
    # Number of scenes.
    episodes: int = 1000
    # Split that they are of: test, or validation while you choose settings.
    split: str = "test"
    # cpu, cuda, or auto: the GPU where there is one. For policies of ours.
    device: str = "auto"
    # JSON file of the numbers; by default eval.json beside the page.
    output: Path | None = None


def main(config: Config) -> None:
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.utils.files import write_json

    if config.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, not {config.episodes}")
    if config.policy and (config.expert or config.checkpoint):
        raise ValueError("--policy and --expert: name one of them")
    folder, text, result = (judge_policy if config.policy else judge_expert)(config)
    print(text)
    who = f"Policy {config.policy}" if config.policy else f"Expert {result['expert']}"
    write_html(folder, f"{who}, {result['task']}", text, command_line(), dataclasses.asdict(config))
    common = {"split": config.split, "episodes": config.episodes, "command": command_line()}
    output = config.output or folder / "eval.json"
    write_json(output, result | common)
    print(f"written: {output}, {folder / 'report.html'}")


def name_folder(config: Config, *names: str) -> Path:
    return Path("runs/evaluate") / "_".join([*names, config.split]).replace("/", "")


def judge_policy(config: Config) -> tuple[Path, str, dict]:
    """The folder with an animation, the numbers as text, and the result: ``DR``, ``PE``, ``SR`` and what became of
    every episode."""
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.protocol import evaluate
    from dynmap_rl.reporting.media import film_policy
    from dynmap_rl.runs.lookup import find_run
    from dynmap_rl.runs.lookup import load_actor
    from dynmap_rl.runs.lookup import task_of_run
    from dynmap_rl.utils.devices import choose_device

    folder = find_run(config.policy)
    task = config.task or task_of_run(folder) or "balance_reaching"
    description = get_task(task, from_file=not config.task).description
    if not folder.exists():
        raise ValueError(f"there is no policy at {config.policy}; train one with recipes/decoupled.py")
    if (folder / "world_model").exists() or any(folder.glob("seed_*")):
        actor = load_actor(folder, config.seed).to(choose_device(config.device))
    elif not Path(config.policy).expanduser().exists() and not config.trust_remote_code:
        raise ValueError(
            f"{config.policy} is a policy of LeRobot on the hub, whose files may name code to run; if you trust whoever "
            "put it there, add --trust_remote_code"
        )
    else:
        actor = load_lerobot(config.policy, description)
    result = evaluate(actor, task, config.episodes, 0, config.split)["test"]
    summary = result["summary"]
    low, high = summary["SR_interval"]
    text = f"DR {summary['DR']:.1f} %   PE {summary['PE']:.1f} mm   SR {summary['SR']:.1f} % [{low:.1f}, {high:.1f}]"
    parts = Path(config.policy).parts[-4:]
    folder = name_folder(config, get_task(task).name, *parts, f"seed_{config.seed}")
    film_policy(actor, task, result["rows"], folder / "rollouts.gif")
    return folder, text, {"task": task, "policy": config.policy, **result}


def load_lerobot(policy: str, instruction: str):
    try:
        from dynmap_rl.integrations.lerobot.actor import LeRobotActor
    except ImportError as error:
        raise ValueError(
            f"{policy} is no run of ours; for a policy of LeRobot: pip install '.[lerobot]' ({error})"
        ) from error
    return LeRobotActor(policy, instruction=instruction)


def judge_expert(config: Config) -> tuple[Path, str, dict]:
    """The folder with an animation, the numbers as text, and the result: ``rates`` and ``intervals`` (%)."""
    from dynmap_rl.envs.geometry import path_is_blocked
    from dynmap_rl.envs.geometry import way_from_start
    from dynmap_rl.envs.scene import ObstacleScene
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.rollout import failures_first
    from dynmap_rl.evaluation.rollout import scene_seeds
    from dynmap_rl.evaluation.statistics import wilson
    from dynmap_rl.reporting.media import film
    from dynmap_rl.experts.network import list_checkpoints
    from dynmap_rl.experts.network import load_expert
    from dynmap_rl.experts.network import roll_out
    from dynmap_rl.experts.network import task_of_expert

    task = get_task(config.task or "balance_reaching")
    expert = config.expert or task.name
    checkpoint = config.checkpoint or list_checkpoints(expert)[-1]
    network, trained_on = load_expert(expert, checkpoint), task_of_expert(expert, task)
    seeds = scene_seeds(config.split, config.episodes)
    worlds = roll_out(network, task, seeds, states=trained_on)
    outcomes = {
        "success": [task.is_success(world) for world in worlds],
        "dropped": [world.dropped for world in worlds],
        "touched": [bool(world.touched) for world in worlds],
    }
    if issubclass(task.ranges.scene, ObstacleScene):
        outcomes["straight_path_blocked"] = [path_is_blocked(world.scene) for world in worlds]
        outcomes["way_leads_around"] = [len(way_from_start(world.scene)) > 2 for world in worlds]
    rates = {name: 100 * sum(values) / len(worlds) for name, values in outcomes.items()}
    intervals = {name: wilson(sum(values), len(worlds)) for name, values in outcomes.items()}
    lines = [
        f"{name.replace('_', ' '):22} {rate:5.1f} % [{intervals[name][0]:.1f}, {intervals[name][1]:.1f}]"
        for name, rate in rates.items()
    ]
    folder = name_folder(config, task.name, *Path(expert).parts[-4:], checkpoint)
    some = failures_first(seeds, outcomes["success"])
    film(network, task, some, folder / "rollouts.gif", states=trained_on)
    result = {"task": config.task or task.name, "expert": expert, "checkpoint": checkpoint}
    return folder, "\n".join(lines), result | {"rates": rates, "intervals": intervals}


if __name__ == "__main__":
    run_recipe(main, Config)
