"""The dataset that a recipe trains on: a given one, or the recorded demonstrations of a task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dynmap_rl.data.cache import hash_content
from dynmap_rl.data.demonstrations import META, find_layout, find_meta
from dynmap_rl.data.format.frames import iterate_frames
from dynmap_rl.data.format.reading import find_dataset, read_column, read_info, read_table
from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.data.settings import Augmentation
from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.keys import CAMERAS
from dynmap_rl.utils.files import read_json, write_json

LEVEL = 30  # difference of a channel, of 0 to 255
SHARE = 0.025  # of the pixels, for tasks that are not in the plane: graphics libraries draw edges differently


def find_or_record(
    task: str, dataset: str | Path | None = None, run: Path | None = None, workers: int = 2
) -> str | Path:
    """Return the dataset to train on.

    Args:
        task: name of the task.
        dataset: folder or hub id; by default ``datasets/TASK``, which is recorded with the shipped expert where it is
            missing.
        run: folder of the run that is trained on it, which keeps a hash of the dataset.
        workers: processes that record.

    Raises:
        ValueError: the dataset is of another task, or of the same task with another camera, scene or goal, holds no
            demonstrations, or has changed since the run began.
    """
    folder = Path("datasets") / get_task(task).name
    if dataset is None and not (folder / META).exists():
        dataset = record_dataset(folder, task, workers=workers)
    else:
        dataset = folder if dataset is None else dataset
        check_dataset(dataset, task)
        check_start(dataset, task)
    if run is not None:
        keep_dataset(run, dataset)
    return dataset


def keep_dataset(run: Path, dataset: str | Path) -> None:
    """Store a hash of a run's dataset, or raise ``ValueError`` where the run has begun with other data."""
    path, found = Path(run) / "dataset.json", {"sha256": hash_content(find_dataset(dataset))}
    if not path.exists():
        write_json(path, found)
    elif read_json(path) != found:
        raise ValueError(
            f"{run} was trained on other data than {dataset} holds now; choose another --run, or delete the folder"
        )


def choose_augmentation(task: BaseTask, augmentation: Augmentation, imitated: bool = False) -> Augmentation:
    """Return the augmentation for windows of a task: none where frames are no flat pictures of the plane.

    Where a policy learns from the windows too (``imitated``), they are mirrored and shifted in symmetric tasks only.

    Raises:
        ValueError: settings other than the default, and the task is not in the plane, or a shift of another size than the
            default, and nothing is shifted.
    """
    if not task.planar and augmentation not in (Augmentation(), Augmentation.off()):
        raise ValueError(f"augmentation has no effect with {task.name}; leave its options out")
    if imitated and not task.symmetric:
        if augmentation.max_shift not in (Augmentation.max_shift, 0):
            raise ValueError(
                f"max_shift has no effect with {task.name}, which is not symmetric; leave it out"
            )
        augmentation = replace(augmentation, mirror=False, max_shift=0)
    return augmentation if task.planar else Augmentation.off()


def check_dataset(dataset: str | Path, task: str) -> None:
    """Raise ``ValueError`` if a dataset is of another task or of another form of it, or holds exploration.

    A dataset without ``meta/dynmap.json``, such as one that LeRobot's tools have edited, is accepted unchecked.
    """
    if (meta := find_meta(find_dataset(dataset))) is None:
        return
    if meta["task"] != task:
        raise ValueError(
            f"{dataset} must be a dataset of {task}, got one of {meta['task']}; choose another --dataset"
        )
    if meta["kind"] == "exploration":
        raise ValueError(
            f"{dataset} holds exploration, which cannot be imitated; choose a --dataset of demonstrations"
        )
    recorded, own = find_layout(meta).to_dict(), get_task(task).layout.to_dict()
    for name in ("cameras", "image_size", "fps", "action", "action_limit", "state"):
        if recorded[name] != own[name]:
            raise ValueError(
                f"{dataset} was recorded with {name} {recorded[name]}, but {task} now has {own[name]}; delete the dataset "
                "to record it again, or choose another --dataset"
            )


def check_start(dataset: str | Path, task: str) -> None:
    """Raise ``ValueError`` if a recording does not begin as the task does now, because its class has changed.

    What a policy reads at the first step of the first episode is compared: ``agent_pos`` with the goal, and the frame, of
    which tasks that are not in the plane may differ in a few pixels. A dataset without the seeds of its scenes is accepted
    unchecked.
    """
    root = find_dataset(dataset)
    if (meta := find_meta(root)) is None:
        return
    info, rules = read_info(root), get_task(task)
    columns = read_table(root, info, ["observation.state"])  # refuses a recording without data files
    views = [iterate_frames(root, info, f"{CAMERAS}{camera}") for camera in rules.layout.cameras]
    first = [next(view) for view in views]
    seeds = {row["episode_index"]: row.get("scene_seed") for row in meta["episodes"]}
    if (seed := seeds.get(first[0][0])) is None:
        return
    recorded = read_column(root, info, columns, "observation.state")[
        columns["episode_index"].to_numpy() == first[0][0]
    ]
    frame, world = np.concatenate([frames[0] for _, frames, _ in first], 1), rules.begin(seed)
    drawn, state = np.array(rules.make_renderer()(world)), np.array(rules.agent_pos(world))
    rules.close(world)
    wrong = {
        "state": not np.allclose(recorded[0], state, atol=1e-3),
        "frame": (np.abs(frame.astype(int) - drawn).max(-1) > LEVEL).mean() > (0 if rules.planar else SHARE),
    }
    if name := next((name for name, found in wrong.items() if found), None):
        raise ValueError(
            f"the first {name} of {dataset} is not that of {task} now: its scene, goal or camera has changed; delete the "
            "dataset to record it again, or choose another --dataset"
        )
