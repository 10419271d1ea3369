"""Run the grid of the MuJoCo tasks: world models, end-to-end training, ACT and Diffusion Policy; write the page.

    python recipes/paper/benchmarks3d.py --dry_run                    # runs, those that are complete, remaining time
    python recipes/paper/benchmarks3d.py --only plateslide --workers 2
    python recipes/paper/benchmarks3d.py --results runs/benchmarks3d_results     # a grid of your own
    python recipes/paper/benchmarks3d.py --write                      # the page from the results alone

Each run executes another recipe for one task, method and seed, and writes a JSON file; runs with a result are skipped.
The same command resumes a stopped grid and its runs. Three rows have dynamics that are derived from the recordings, in
datasets/TASK_hand, _tracks and _color. The page has success, failures by cause, and animations. Needs
uv pip install -e '.[lerobot,mujoco]'.
"""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dynmap_rl.utils.cli import run_recipe
from dynmap_rl.utils.settings import check_at_least

RECIPES = Path(__file__).parents[1]


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Folder of the results; by default that of the repository.
    results: Path = RECIPES / "results/benchmarks3d"
    # Folder of the runs.
    runs: Path = Path("runs/benchmarks3d")
    # Runs to execute: a part of their names.
    only: str = ""
    # Scenes of an evaluation.
    episodes: int = 500
    # Runs at a time on this machine; each takes two cores if it is alone, otherwise one.
    workers: int = 1
    # Folder with a settings file RECIPE.yaml for any of the recipes, passed to them as --config_path.
    presets: Path | None = None
    # List the runs and stop.
    dry_run: bool = False
    # Write README.md in the folder of the results from the results alone, and stop.
    write: bool = False

    def __post_init__(self):
        check_at_least(self, 1, "workers", "episodes")
        if self.presets and not self.presets.is_dir():
            raise ValueError(f"--presets must be a folder, got {self.presets}")


def main(config: Config) -> None:
    """Execute the runs without a result, and write the page."""
    from dynmap_rl.paper.benchmarks import derive_dataset, list_benchmarks
    from dynmap_rl.paper.launch import execute, is_done, launch, print_runs
    from dynmap_rl.paper.sources import copy_quality
    from dynmap_rl.utils.files import read_json

    if config.write:
        return write(config)
    runs = [run for run in list_benchmarks(config.episodes).values() if config.only in run.name]
    if not runs:
        raise ValueError(f"--only must be a part of a run's name, got {config.only!r}; see --dry_run")
    todo = [run for run in runs if not is_done(run.name, config.results)]
    for path in (config.results / f"{run.name}.json" for run in runs if run not in todo):
        if (scenes := read_json(path)["test_protocol"]["episodes"]) != config.episodes:
            raise ValueError(
                f"{path} has {scenes} --episodes instead of {config.episodes}; choose another --results and --runs"
            )
    if config.dry_run:
        return print_runs(runs, todo)
    from dynmap_rl.training.dataset import find_or_record

    recordings = {task: find_or_record(task) for task in sorted({run.task for run in todo})}
    for run in todo:  # runs must not record or derive at the same time
        if run.dataset:
            task = run.task.removeprefix("mujoco:")
            derive_dataset(task, recordings[run.task], run.cell[-1], Path(run.dataset))
    start = partial(
        execute, recipes=RECIPES, results=config.results, runs=config.runs,
        threads=2 if config.workers == 1 else 1, presets=config.presets, root=Path.cwd(),
    )  # fmt: skip
    failed = launch(todo, start, workers=config.workers)
    copy_quality(runs, config.results)
    copy_pictures([run for run in todo if is_done(run.name, config.results)], config)
    if len(failed) < len(runs):  # something is there to write
        write(config)
    if failed:
        raise ValueError("; ".join(failed))
    return None


def write(config: Config) -> None:
    """Write ``README.md`` from the results, and print the table."""
    from dynmap_rl.paper.benchmarks import benchmark_page, benchmark_rows, benchmark_table, read_experts
    from dynmap_rl.utils.files import write_bytes

    rows = benchmark_rows(config.results)
    if not rows:
        raise ValueError(f"{config.results} must have results; run recipes/paper/benchmarks3d.py first")
    write_bytes(config.results / "README.md", benchmark_page(rows, config.results).encode())
    print(benchmark_table(rows, read_experts(config.results)))
    print(f"written: {config.results / 'README.md'}")


def copy_pictures(runs: list, config: Config) -> None:
    """Copy the animation of RGB+[P+V] with the first seed, failures first, to the results."""
    from dynmap_rl.utils.files import write_bytes

    for run in runs:
        animation = config.runs / run.name / "rollouts.gif"
        if run.name.endswith("rgb_p_v_seed_0") and animation.exists():
            write_bytes(config.results / f"{run.name}.gif", animation.read_bytes())


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
