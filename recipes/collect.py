"""Record expert demonstrations as a LeRobot dataset (paper, Sec. IV-C).

    python recipes/collect.py                                  # 300 + 50 demonstrations of task 1
    python recipes/collect.py --kind undisturbed               # without noise and pushes
    python recipes/collect.py --kind exploration               # detours, noise and drops
    python recipes/collect.py --push_to_hub user/name

The experts ship with the package. The same command resumes a stopped recording. The page report.html in runs/collect
shows what was recorded.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line, refuse, run_recipe


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Task: balance_reaching, balance_reaching_obstacle, bin_dropping, mujoco:FetchPush (FetchSlide, PlateSlide, Soccer),
    # or module:Class of your own.
    task: str = "balance_reaching"
    # demonstrations (successful episodes only), undisturbed (such demonstrations without noise and pushes), or
    # exploration (noisy experts on detours, all episodes).
    kind: str = "demonstrations"
    # Episodes of the split train.
    episodes: int = 300
    # Episodes of the split eval, held out.
    eval_episodes: int = 50
    # Folder of the dataset; by default datasets/TASK, or datasets/TASK_KIND for the other kinds.
    output: Path | None = None
    # Folder of the expert's checkpoints (of a run of recipes/expert.py); by default the one that ships for the task.
    expert: Path | None = None
    # Processes that roll out and write.
    workers: int = 2
    # local, or ray: a CPU of a Ray cluster for every 25 episodes, in the place of --workers.
    launcher: str = "local"
    # Id on the Hugging Face hub (user/name) to upload the dataset to.
    push_to_hub: str | None = None


def main(config: Config) -> None:
    """Record, report and upload."""
    from dynmap_rl.data.demonstrations import META, load_meta
    from dynmap_rl.data.format.hub import check_login, check_uploadable, push_dataset
    from dynmap_rl.data.recording.record import record_dataset
    from dynmap_rl.envs.tasks import get_task
    from dynmap_rl.reporting.dataset_page import write_dataset_page
    from dynmap_rl.runs.folder import plain_settings

    suffix = "" if config.kind == "demonstrations" else f"_{config.kind}"
    output = config.output or Path("datasets") / f"{get_task(config.task).name}{suffix}"
    if config.launcher == "ray":
        refuse(config, Config(), ["workers"], "--launcher ray")
    if config.push_to_hub:
        check_uploadable(config.task, get_task(config.task).layout)
        check_login()
    complete = (output / META).exists()
    sizes = config.episodes, config.eval_episodes
    record_dataset(output, config.task, config.kind, *sizes, config.workers, config.expert, config.launcher)
    print(f"{'already complete' if complete else 'written'}: {output}")
    folder = Path("runs/collect") / output.name
    said = f"{load_meta(output)['rejected']} further candidates failed and were left out"
    print(said)
    write_dataset_page(folder, output, plain_settings(config), command_line(sys.argv), said)
    if config.push_to_hub:
        push_dataset(output, config.push_to_hub)
        print(f"pushed: {config.push_to_hub}")


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
