"""What recipes check, and the dataset they find or record, before they train."""

from __future__ import annotations

import os
from pathlib import Path

from tensordict import TensorDictBase

from dynmap_rl.data.demonstrations import META, load_dataset, load_meta
from dynmap_rl.data.recording.shards import record_dataset
from dynmap_rl.data.robot import describe_foreign, load_foreign, range_constants
from dynmap_rl.envs.tasks import NO_TASK, get_task
from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.evaluation.protocol import SHARED_STARTS
from dynmap_rl.modules.checkpoints import check_policy
from dynmap_rl.modules.supervision import parse_supervision
from dynmap_rl.runs.loggers import check_logger
from dynmap_rl.utils.cli import check_at_least_one
from dynmap_rl.utils.devices import choose_device

# What replaces defaults where a dataset is of no task of ours. The weights of changed actions suppose that actions are
# changes and begin at rest, the bars a background of one colour.
FOREIGN = {"emphasis": 0.0, "distractors": 0}


def check_settings(settings) -> list[int]:
    """Refuse what cannot run, before anything is written.

    Args:
        settings: with ``task``, ``device``, ``logger``, ``policy``, ``seeds``, ``dataset``, ``split``, ``test_episodes``, ``paper_episodes``
            and, where there are any, ``updates``, ``policy_updates`` and ``window_steps``. Where it has ``camera``,
            ``goal`` and ``supervision`` too, its task may be none.

    Returns:
        The seeds of the policies.

    Raises:
        ValueError: a setting is wrong; the message says which.
    """
    foreign = settings.task == NO_TASK and hasattr(settings, "camera")
    if not foreign:
        get_task(settings.task)
    choose_device(settings.device)
    check_logger(settings.logger)
    check_policy(settings.policy)
    try:
        seeds = [int(seed) for seed in settings.seeds.split(",")]
    except ValueError as error:
        raise ValueError(f"--seeds are whole numbers such as 0,1,2, not {settings.seeds!r}") from error
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"--seeds {settings.seeds} has one twice")
    if settings.split not in ("test", "validation"):
        raise ValueError(f"--split is test or validation, not {settings.split!r}")
    if settings.test_episodes > SHARED_STARTS:
        raise ValueError(f"there are {SHARED_STARTS} shared start states, not {settings.test_episodes}")
    numbers = "updates", "windows", "rgb_steps", "policy_updates", "policy_batch", "threads"
    check_at_least_one(settings, *numbers, "test_episodes", "paper_episodes")
    for name in ("copies", "distractors", "emphasis", "beta_z", "beta_dynamics", "beta_joint"):
        if (value := getattr(settings, name, 0)) < 0:
            raise ValueError(f"--{name} must not be negative, not {value}")
    if not 2 <= (steps := getattr(settings, "window_steps", 2)) <= EPISODE_STEPS:
        raise ValueError(f"--window_steps must be 2 to {EPISODE_STEPS}, not {steps}")
    if foreign:
        if not settings.dataset:
            raise ValueError("--task none needs a --dataset: a folder or a hub id")
        supervision = parse_supervision(settings.supervision)
        describe_foreign(settings.dataset, settings.camera, settings.goal, supervision)
    elif getattr(settings, "camera", None) or getattr(settings, "goal", None):
        raise ValueError(
            "--camera and --goal are for --task none; our own tasks have one camera and their goal"
        )
    elif settings.dataset:
        check_dataset(settings.dataset, settings.task)
    return seeds


def check_dataset(dataset: str | Path, task: str) -> None:
    """Raises ``ValueError`` for a dataset that is of another task, or of no demonstrations: there is nothing to imitate."""
    meta = load_meta(dataset)
    if meta["task"] != task:
        raise ValueError(f"{dataset} is of {meta['task']}, not of {task}; choose another --dataset")
    if meta["kind"] == "exploration":
        raise ValueError(
            f"{dataset} is of exploration, which is not to be imitated; choose another --dataset"
        )


def find_or_record(settings) -> str | Path:
    """The dataset of the settings, or ``datasets/TASK``, recorded if it is not there (six episodes for a smoke run).

    Raises:
        ValueError: ``datasets/TASK`` is of another task, or of no demonstrations.
    """
    if settings.dataset:
        return settings.dataset
    folder = Path("datasets") / get_task(settings.task).name
    if not settings.smoke and (folder / META).exists():
        check_dataset(folder, settings.task)
        return folder
    if settings.smoke:
        folder = folder.with_name(f"{folder.name}_smoke")
        return record_dataset(folder, settings.task, episodes=4, eval_episodes=2, workers=1)
    return record_dataset(folder, settings.task)


def load_episodes(settings, dataset: str | Path) -> tuple[dict[str, TensorDictBase], dict]:
    """The splits ``train`` and ``eval`` of the settings' dataset, and its constants of normalisation."""
    if settings.task == NO_TASK:
        episodes = load_foreign(dataset, settings.window_steps, settings.camera, settings.goal)
        return episodes, range_constants(episodes["train"])
    episodes = {split: load_dataset(dataset, split) for split in ("train", "eval")}
    return episodes, load_meta(dataset)["normalization"]


def name_task(settings) -> str:
    """What a run's folder is named after: the task, or the dataset that is of none."""
    if settings.task == NO_TASK:
        return os.path.basename(os.path.abspath(settings.dataset))  # never ".."
    return get_task(settings.task).name


def describe_source(settings, training: str) -> dict[str, str]:
    """Where a world model of this run is from."""
    source = {"task": settings.task, "training": training}
    return source | ({"dataset": settings.dataset} if settings.task == NO_TASK else {})
