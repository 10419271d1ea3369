"""Draw figures from datasets.

    python recipes/collect.py && python recipes/collect.py --task bin_dropping
    python recipes/figures.py

Draws how the angles and angular velocities of tasks are distributed, side by side, and writes their ranges as JSON.
"""

from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.runs import run_recipe


@dataclass
class Config:
    # Datasets, folders or hub ids, separated by commas.
    datasets: str = "datasets/balance_reaching,datasets/balance_reaching_obstacle,datasets/bin_dropping"
    # Folder of the figures.
    output: Path = Path("runs/figures")


def main(config: Config) -> None:
    from dynmap_rl.data import load_dataset, load_meta
    from dynmap_rl.evaluation.figures import plot_distributions
    from dynmap_rl.runs import command_line, write_json

    names = [name.strip() for name in config.datasets.split(",")]
    tasks = [load_meta(name)["task"] for name in names]
    if len(set(tasks)) < len(tasks):
        raise ValueError(f"--datasets are of the tasks {', '.join(tasks)}; name one of each")
    dynamics = {
        task: load_dataset(name, "train")["dynamics"] for task, name in zip(tasks, names, strict=True)
    }
    ranges = plot_distributions(dynamics, config.output / "distributions.png")
    facts = {"command": command_line(), "datasets": names, "ranges": ranges}
    write_json(config.output / "distributions.json", facts)
    print(f"written: {config.output}/distributions.png and .json")


if __name__ == "__main__":
    run_recipe(main, Config)
