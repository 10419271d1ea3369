"""Measure what the states of world models hold, and how far their predictions carry without frames.

    python recipes/probe.py --runs runs/decoupled/balance_reaching/position_velocity_recurrent
    python recipes/probe.py --runs balance_reaching,runs/decoupled/balance_reaching/none_recurrent
    python recipes/probe.py --runs runs/decoupled/fetch_push/position_velocity_recurrent

Linear maps from each state to position, velocity and acceleration are fitted to training demonstrations (R^2 on held-out
ones); a world model whose best state explains 0.75 of the velocities is judged good, before any policy is trained.

On tasks of cart and block, every world model that decodes positions also reads one second of held-out frames and predicts
two more seconds without frames, from the actions (mm and degrees, beside a constant prediction). What the world models see is
measured on held-out demonstrations and on the expert's first ten steps in validation scenes: colours of objects and goal in
predicted frames, and the cart's position by a linear map of the latent. The folder of the results gets figures,
``probe.json`` and ``report.html``.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.settings import check_at_least


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Runs with world models, with commas between: folders, hub ids, or balance_reaching (shipped).
    runs: str = "runs/decoupled/balance_reaching/position_velocity_recurrent"
    # Task of the runs, where it is module:Class of your own.
    task: str | None = None
    # Dataset of the runs' task: a folder or a hub id; by default datasets/TASK, recorded where it is missing.
    dataset: str | None = None
    # Folder for decoded datasets; by default DATASET.cache beside the dataset.
    cache: Path | None = None
    # Demonstrations that the linear maps are fitted to.
    train_episodes: int = 100
    # Held-out demonstrations of all measurements.
    test_episodes: int = 50
    # Steps (50 ms) with frames, at first.
    context: int = 20
    # Steps that are then predicted without frames.
    horizon: int = 40
    # Folder of the results.
    output: Path = Path("runs/probe")

    def __post_init__(self):
        check_at_least(self, 1, "train_episodes", "test_episodes", "context", "horizon")


def main(config: Config) -> None:
    """Measure, draw and report."""
    from dynmap_rl.data.demonstrations import load_dataset
    from dynmap_rl.envs.task import Task
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.open_loop import decodes_poses, open_loop_errors
    from dynmap_rl.evaluation.probing import judge_states, probe
    from dynmap_rl.reporting.figures import plot_open_loop, plot_perception, plot_probes
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.runs.folder import plain_settings
    from dynmap_rl.training.dataset import find_or_record
    from dynmap_rl.utils.files import write_json
    from dynmap_rl.utils.version import find_commit

    if config.task:
        get_task(config.task)  # files of runs must import nothing
    models, task = load_world_models(config.runs.split(","))
    rules, open_loop, perception = get_task(task), {}, {}
    if not isinstance(rules, Task):
        refuse(config, Config(), ["context", "horizon"], f"--runs of {task}")
    elif (steps := rules.layout.steps) < config.context + config.horizon:
        raise ValueError(
            f"--context + --horizon must be at most {steps}, got {config.context} + {config.horizon}; an episode has no more"
        )
    dataset = find_or_record(task, config.dataset)
    train = load_dataset(dataset, "train", config.cache)[: config.train_episodes]
    test = load_dataset(dataset, "eval", config.cache)[: config.test_episodes]
    names = rules.layout.dynamics["position"]
    if (entries := test["dynamics", "position"].shape[-1]) != len(names):
        raise ValueError(
            f"--dataset must have the dynamics of {task}, {len(names)} entries, got {entries}; use the recording that it is "
            "derived from"
        )
    if "labelled" in test.keys() and not test["labelled"].all():
        raise ValueError(
            "--dataset must have the dynamics of every frame, got tracks with gaps; use the recording that they are of"
        )
    probes = {name: probe(model, train, test) for name, model in models.items()}
    if isinstance(rules, Task):
        open_loop = {
            name: open_loop_errors(model, test, config.context, config.horizon)
            for name, model in models.items()
            if decodes_poses(model)
        }
        perception = measure_perception(models, task, dataset, train, test)
    verdicts = {name: judge_states(probed) for name, probed in probes.items()}
    facts = {"command": command_line(sys.argv), "commit": find_commit()}
    facts |= {"train_episodes": len(train), "test_episodes": len(test), "open_loop": open_loop}
    facts |= {"probes": probes, "perception": perception, "verdicts": verdicts}
    text = describe(facts, rules.layout.dynamics["velocity"], 0.05 * config.horizon)
    print(text)
    (config.output / "open_loop.png").unlink(missing_ok=True)  # of other --runs
    if open_loop:
        plot_open_loop(open_loop, config.output / "open_loop.png")
    plot_probes(probes, config.output / "probes.png")
    plot_perception(models, test[:8], config.output / "perception.png", dt=rules.layout.dt)
    write_html(config.output, "States of world models", text, facts["command"], plain_settings(config))
    write_json(config.output / "probe.json", facts)
    print(f"written: {config.output}")


def measure_perception(models: dict, task: str, dataset: str | Path, train, test) -> dict[str, dict]:
    """Measure what world models see on held-out demonstrations and at the begin of other scenes."""
    from dynmap_rl.data.demonstrations import META
    from dynmap_rl.data.format.reading import find_dataset, read_metadata
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.evaluation.perception import begin_scenes, color_errors, locate_cart

    meta = read_metadata(find_dataset(dataset) / META, {"episodes": [{"split": str, "scene": dict}]})
    rows = [row for row in meta["episodes"] if row["split"] == "eval"][: len(test)]
    read_scene = get_task(task).ranges.scene.from_dict
    places = {
        "held-out demonstrations": (test, [read_scene(row["scene"]) for row in rows]),
        "first ten steps": begin_scenes(task, len(test)),
    }
    return {
        name: {
            where: color_errors(model, episodes, scenes) | {"cart_error": locate_cart(model, train, episodes)}
            for where, (episodes, scenes) in places.items()
        }
        for name, model in models.items()
    }


def load_world_models(runs: list[str]) -> tuple[dict, str]:
    """Load the world models of runs, by the names of their rows and, where those are equal, of the runs; and their task."""
    from collections import Counter

    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.modules.supervision import row_name
    from dynmap_rl.runs.lookup import load_world_model_of

    models, tasks = {}, {}
    for run in dict.fromkeys(run.strip().rstrip("/") for run in runs):
        world_model, origin = load_world_model_of(run)
        if "task" not in origin:
            raise ValueError(
                f"--runs must be of a task, got {run}; recipes/robot.py judges its world models itself"
            )
        get_task(origin["task"], from_file=True)
        tasks.setdefault(origin["task"], run)
        row = f"{row_name(world_model.supervision, origin['training'])}, {origin['training']}"
        if world_model.architecture != "glimpse":
            row += f", {world_model.architecture}"
        models[row, run] = world_model
    if len(tasks) > 1:
        found = ", ".join(f"{run} of {task}" for task, run in tasks.items())
        raise ValueError(f"--runs must have world models of one task, got {found}; probe each task by itself")
    rows, names = Counter(row for row, _ in models), Counter(Path(run).name for _, run in models)
    named = {
        row if rows[row] == 1 else f"{row}, {Path(run).name if names[Path(run).name] == 1 else run}": model
        for (row, run), model in models.items()
    }
    return named, next(iter(tasks))


def describe(facts: dict, entries: tuple, seconds: float) -> str:
    """Return the results as lines of text; ``entries`` are the names of the velocities."""
    import numpy as np

    from dynmap_rl.evaluation.probing import judged_text

    lines = []
    for name, errors in facts["open_loop"].items():
        last = {key: values[-1] for key, values in errors["model"].items()}
        distances = f"cart {last['cart_mm']:.0f} mm, block {last['block_mm']:.0f} mm"
        lines.append(f"{name}: error after {seconds:.1f} s without frames: {distances}")
    for name, places in facts["perception"].items():
        for where, found in places.items():
            lines.append(
                f"{name}, {where}: colour error on objects {found['object_error']:.3f}, chroma explained "
                f"{found['chroma_explained']:.2f}, colour of the goal explained {found['goal_explained']:.2f}, background error "
                f"{found['background_error']:.3f}, cart by a linear map "
                f"{1000 * found['cart_error']:.1f} mm"
            )
    for name, states in facts["probes"].items():
        for state, quantities in states.items():
            values = "  ".join(f"{q} {np.nanmean(r2):5.2f}" for q, r2 in quantities.items())
            lines.append(f"{name}: R^2 of {state:8} {values}")
    for name, found in facts["verdicts"].items():
        pairs = zip(entries, facts["probes"][name][found["state"]]["velocity"], strict=True)
        lines.append(
            f"{name}: {judged_text(found)}: " + ", ".join(f"{entry} {r2:.2f}" for entry, r2 in pairs)
        )
    return "\n".join(lines)


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv, stopped="repeat the command")
