"""Judge an expert on a task's test scenes; the expert may be that of another task.

    python recipes/evaluate.py --task bin_dropping
    python recipes/evaluate.py --task balance_reaching_obstacle --expert balance_reaching

Prints success, drop and touch rates with 95 % Wilson intervals, for task 2 also how often the straight path to the
goal is blocked and how often the shortest way leads around the obstacle, and writes them as JSON.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.runs import run_recipe


@dataclass
class Config:
    # Name of the task: balance_reaching, balance_reaching_obstacle, bin_dropping, or module:Class of your own.
    task: str = "balance_reaching"
    # Expert: the name of the task that it ships for, or a folder of checkpoints; by default the task's own.
    expert: str | None = None
    # Its checkpoint; by default the last.
    checkpoint: str | None = None
    # Scenes, and the split they are of.
    episodes: int = 1000
    split: str = "test"
    # JSON file; by default runs/evaluate/TASK_EXPERT_CHECKPOINT_SPLIT.json.
    output: Path | None = None


def main(config: Config) -> None:
    from dynmap_rl.envs.geometry import path_is_blocked, way_from_start
    from dynmap_rl.envs.scene import ObstacleScene
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation import scene_seeds, wilson
    from dynmap_rl.experts import find_expert, list_checkpoints, load_expert, roll_out
    from dynmap_rl.runs import command_line, read_json, write_json

    task = get_task(config.task)
    if config.episodes < 1:
        raise ValueError(f"--episodes must be at least 1, not {config.episodes}")
    expert = config.expert or task.name
    checkpoint = config.checkpoint or list_checkpoints(expert)[-1]
    network = load_expert(expert, checkpoint)
    trained_on = get_task(read_json(find_expert(expert) / f"{checkpoint}.json")["task"])
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
    for name, rate in rates.items():
        low, high = intervals[name]
        print(f"{name.replace('_', ' '):22} {rate:5.1f} % [{low:.1f}, {high:.1f}]")
    name = f"{task.name}_{trained_on.name}_{checkpoint}_{config.split}.json"
    output = config.output or Path("runs/evaluate") / name
    write_json(
        output,
        {
            "task": config.task,
            "expert": expert,
            "checkpoint": checkpoint,
            "split": config.split,
            "episodes": len(worlds),
            "rates": rates,
            "intervals": intervals,
            "command": command_line(),
        },
    )
    print(f"written: {output}")


if __name__ == "__main__":
    run_recipe(main, Config)
