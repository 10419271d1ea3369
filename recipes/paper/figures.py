"""Draw the paper's figures from the runs of recipes/paper/tables.py and from the datasets.

    python recipes/paper/figures.py
    python recipes/paper/figures.py --only fig2,fig7,distributions

Fig. 2 to 4 show demonstrations, Fig. 6 and 9 predictions of a world model of task 1 on tasks 1 and 3, Fig. 7 policy
losses, Fig. 8 closed-loop episodes; Fig. 1 and 5 of the paper are diagrams. The figure distributions shows angles and
angular velocities in the demonstrations, failures the failed episodes of some cells by cause; both come with JSON.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.paper.launch import find_missing
from dynmap_rl.utils.cli import command_line, run_recipe
from dynmap_rl.utils.settings import check_choice

TASKS = {
    "balance_reaching": "Task 1: Balance-Reaching",
    "balance_reaching_obstacle": "Task 2: Balance-Reaching[v2]",
    "bin_dropping": "Task 3: Bin-Dropping",
}
ONE, _, THREE = TASKS
WORLD_MODEL = f"{ONE}_decoupled_position_velocity_acceleration_recurrent"  # for Fig. 6 and 9
FORMS = {"plain": "plain", "glimpse": "decoupled"}  # in names of runs
POLICIES = {  # for Fig. 8
    "(a) Only-RGB, feedforward policy": "none_feedforward",
    "(b) RGB+[P+V], recurrent policy": "position_velocity_recurrent",
}


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Folder with the runs of recipes/paper/tables.py.
    runs: Path = Path("runs/tables")
    # Folder of the results of recipes/paper/tables.py, for fig7; by default those of the repository.
    results: Path = Path(__file__).parents[1] / "results/cells"
    # Form of the world models of fig7 and fig8: plain, which is nearer to the paper's, or glimpse.
    architecture: str = "plain"
    # Folder of the figures.
    output: Path = Path("runs/figures")
    # Names of figures, such as fig2,fig7; by default all.
    only: str = ""
    # Datasets with commas between, folders or hub ids; by default datasets/TASK, recorded where they are missing.
    datasets: str | None = None


def main(config: Config) -> None:
    """Draw the figures and a page; a figure that cannot be drawn is an error at the end."""
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import plain_settings

    check_choice(config, "architecture", FORMS)
    names = [name.strip() for name in config.only.split(",")] if config.only else list(FIGURES)
    if unknown := sorted(set(names) - set(FIGURES)):
        raise ValueError(f"--only must be any of {', '.join(FIGURES)}, got {', '.join(unknown)}")
    datasets, drawn, missing = name_datasets(config), [], []
    for name in names:
        try:
            FIGURES[name][0](config, datasets)
            print(f"written: {config.output / name}.png", flush=True)
            drawn.append(name)
        except ValueError as error:
            missing.append(f"{name}: {error}")
    if drawn:
        captions = {f"{name}.png": FIGURES[name][1] for name in drawn}
        text = "\n".join([f"drawn: {', '.join(drawn)}", *missing])
        facts = text, command_line(sys.argv), plain_settings(config), captions
        write_html(config.output, "The paper's figures", *facts)
    if missing:
        raise ValueError("; ".join(missing))


def name_datasets(config: Config) -> dict[str, str | Path]:
    """Return the dataset of each task: those of the settings, or datasets/TASK."""
    from dynmap_rl.data.demonstrations import load_meta

    if not config.datasets:
        return {task: Path("datasets") / task for task in TASKS}
    folders = [name.strip() for name in config.datasets.split(",")]
    tasks = [load_meta(folder)["task"] for folder in folders]
    if sorted(tasks) != sorted(set(tasks) & set(TASKS)):
        raise ValueError(f"--datasets must be one of each of tasks 1 to 3, got {', '.join(tasks)}")
    return dict(zip(tasks, folders, strict=True))


def load_episodes(config: Config, datasets: dict, task: str, split: str = "eval"):
    """Load the episodes ``[E, T]`` of a task, which are recorded if no dataset is given and none is there."""
    from dynmap_rl.data.demonstrations import load_dataset
    from dynmap_rl.training.dataset import find_or_record

    if task not in datasets:
        raise ValueError(f"a dataset of {task} is needed; add it to --datasets")
    return load_dataset(find_or_record(task, datasets[task] if config.datasets else None), split)


def draw_distributions(config: Config, datasets: dict) -> None:
    """Draw the distributions of angles and angular velocities."""
    from dynmap_rl.reporting.figures import plot_distributions
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit

    dynamics = {task: load_episodes(config, datasets, task, "train")["dynamics"] for task in datasets}
    ranges = plot_distributions(dynamics, config.output / "distributions.png")
    facts = {"command": command_line(sys.argv), "commit": find_commit(), "ranges": ranges}
    write_json(config.output / "distributions.json", facts | {"datasets": list(map(str, datasets.values()))})


def draw_fig2(config: Config, datasets: dict) -> None:
    """Draw a demonstration over time."""
    from dynmap_rl.data.demonstrations import load_meta
    from dynmap_rl.paper.figures import plot_trajectory, widest_ways

    episode = widest_ways(load_episodes(config, datasets, ONE), 1)[0]
    plot_trajectory(episode, load_meta(datasets[ONE])["normalization"], config.output / "fig2.png")


def draw_fig3(config: Config, datasets: dict) -> None:
    """Draw a demonstration of each task."""
    from dynmap_rl.paper.figures import plot_film_strips, widest_ways

    strips = {TASKS[t]: widest_ways(load_episodes(config, datasets, t), 1)[0] for t in datasets}
    plot_film_strips(strips, config.output / "fig3.png")


def draw_fig4(config: Config, datasets: dict) -> None:
    """Draw start states."""
    from dynmap_rl.paper.figures import plot_scenes

    plot_scenes(load_episodes(config, datasets, ONE)["pixels"][:, 0], config.output / "fig4.png")


def draw_prediction(config: Config, datasets: dict, task: str, name: str) -> None:
    """Draw predictions of the world model of task 1 on a task (Fig. 6 and 9)."""
    from dynmap_rl.modules.checkpoints import load_world_model
    from dynmap_rl.paper.figures import widest_ways
    from dynmap_rl.reporting.figures import plot_prediction

    find_missing(config.runs, [WORLD_MODEL])
    world_model = load_world_model(config.runs / WORLD_MODEL / "world_model")
    title = f"World model of task 1 (RGB+[P+V+A]) on held-out episodes of {TASKS[task]}"
    episodes = widest_ways(load_episodes(config, datasets, task), 2)
    plot_prediction(world_model, episodes, config.output / f"{name}.png", title)


def draw_fig7(config: Config, datasets: dict) -> None:
    """Draw the policies' losses on held-out demonstrations."""
    from dynmap_rl.paper.figures import find_losses, loss_panels, plot_losses

    panels = loss_panels(ONE, config.architecture)
    plot_losses(panels, find_losses(panels, config.results), config.output / "fig7.png")


def draw_fig8(config: Config, datasets: dict) -> None:
    """Draw position errors of the first policy seed by the paper's protocol."""
    from dynmap_rl.envs.scene import scene_seeds
    from dynmap_rl.evaluation.rollout import roll_out
    from dynmap_rl.evaluation.settings import SHARED_STARTS
    from dynmap_rl.paper.figures import plot_position_errors
    from dynmap_rl.runs.lookup import load_actor

    cells = [f"{ONE}_{FORMS[config.architecture]}_{name}" for name in POLICIES.values()]
    missing, seeds = find_missing(config.runs, cells), scene_seeds("test", 50, start=SHARED_STARTS)
    episodes = [None if c in missing else roll_out(load_actor(config.runs / c), ONE, seeds) for c in cells]
    plot_position_errors(dict(zip(POLICIES, episodes, strict=True)), config.output / "fig8.png")


def draw_failures(config: Config, datasets: dict) -> None:
    """Draw the failures of some cells by cause, and write them as JSON."""
    from dynmap_rl.paper.failures import CELLS, find_failures, plot_failures
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit

    missing = find_missing(config.runs, [name for names in CELLS for name in names])
    cells = [[config.runs / name for name in names if name not in missing] for names in CELLS]
    failures = [find_failures(runs) for runs in cells if runs]
    plot_failures(failures, config.output / "failures.png")
    facts = {"command": command_line(sys.argv), "commit": find_commit(), "failures": failures}
    write_json(config.output / "failures.json", facts)


FIGURES = {  # functions and captions
    "fig2": (draw_fig2, "Fig. 2: a demonstration over time"),
    "fig3": (draw_fig3, "Fig. 3: demonstrations of the tasks"),
    "fig4": (draw_fig4, "Fig. 4: start states"),
    "fig6": (partial(draw_prediction, task=ONE, name="fig6"), "Fig. 6: predictions on task 1"),
    "fig7": (draw_fig7, "Fig. 7: policy losses"),
    "fig8": (draw_fig8, "Fig. 8: position errors in closed loop"),
    "fig9": (partial(draw_prediction, task=THREE, name="fig9"), "Fig. 9: predictions on task 3"),
    "distributions": (draw_distributions, "Angles and angular velocities"),
    "failures": (draw_failures, "Failed episodes by cause"),
}


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv, stopped="repeat the command")
