"""Writing of rollouts as LeRobot v3.0 datasets, and merging of such datasets."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

import cv2
import numpy as np
from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.keys import CAMERAS

from ..demonstrations import load_dataset
from .quiet import quiet
from .reading import decode_image, read_column, read_info, read_table

LOCAL_ID = "dynmap_rl/recording"  # LeRobot needs an id; it is not stored


def make_features(layout: Layout) -> dict[str, dict]:
    """Return LeRobot's description of the columns of a recording."""
    side = layout.image_size
    image = {"dtype": "image", "shape": (side, side, 3), "names": ["height", "width", "channels"]}

    def vector(*names: str, dtype: str = "float32") -> dict:
        return {"dtype": dtype, "shape": (len(names),), "names": list(names)}

    return {
        **{f"{CAMERAS}{camera}": image for camera in layout.cameras},
        "observation.state": vector(*layout.state),
        "action": vector(*layout.action),
        "expert_action": vector(*layout.action),
        "next.reward": vector("reward"),
        "next.done": vector("done", dtype="bool"),
        "next.success": vector("success", dtype="bool"),
        "disturbed": vector("disturbed", dtype="bool"),
        **{f"dynamics.{quantity}": vector(*names) for quantity, names in layout.dynamics.items()},
    }


def write_episodes(folder: Path, episodes: TensorDict, instruction: str, layout: Layout) -> None:
    """Write rollouts as a new dataset, and read it back.

    Args:
        folder: folder of the dataset, which must not exist.
        episodes: ``[E, T]`` with the entries of :func:`dynmap_rl.data.recording.plans.roll_out` and ``disturbed`` bool
            ``[E, T, 1]``.
        instruction: the task in one sentence.
        layout: sizes and names of the task.

    Raises:
        OSError: the folder does not hold what was written.
    """
    columns, features = _to_columns(episodes, layout), make_features(layout)
    with quiet():
        from lerobot.datasets import LeRobotDataset

        dataset = LeRobotDataset.create(
            LOCAL_ID, layout.fps, features, root=folder, robot_type=layout.robot, use_videos=False
        )
        with _without_cache(), _images_in_memory():
            for episode in range(len(columns["action"])):
                of_episode = {name: values[episode] for name, values in columns.items()}
                dataset.save_episode(_make_buffer(of_episode, episode, features, instruction, layout.fps))
        dataset.finalize()
    written = load_dataset(folder, layout=layout)
    # LeRobot only logs a frame that could not be written.
    for key in ("pixels", "agent_pos", "action", "dynamics", "disturbed", "expert_action"):
        if not (written[key] == episodes[key]).all():
            raise OSError(f"{key} of {folder} must be as written, got other values; check the disk")


def _make_buffer(
    columns: dict[str, np.ndarray], number: int, features: dict, instruction: str, fps: int
) -> dict:
    """Return an episode as LeRobot's buffer holds it, with image files in memory, several times as fast as by frames."""
    steps = len(columns["action"])
    buffer = {
        "size": steps,
        "task": [instruction] * steps,
        "episode_index": number,
        "frame_index": np.arange(steps),
        "timestamp": np.arange(steps) / fps,
        "index": [],  # LeRobot fills these
        "task_index": [],
    }
    for name, values in columns.items():
        if features[name]["dtype"] == "image":
            buffer[name] = [
                {"bytes": _encode(frame), "path": f"frame-{t:06d}.png"} for t, frame in enumerate(values)
            ]
        else:
            # LeRobot computes statistics in the buffer's precision, and float32 is not enough for variances.
            buffer[name] = values.astype(np.float64) if values.dtype == np.float32 else values
    return buffer


def _encode(frame: np.ndarray) -> bytes:
    """Return a PNG file of a frame ``[height, width, 3]`` (RGB)."""
    done, file = cv2.imencode(".png", cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError("a frame could not be encoded")
    return file.tobytes()


def merge_datasets(
    folders: list[Path], into: Path, splits: dict[str, list[int]], layout: Layout
) -> TensorDict:
    """Merge datasets into a new one, with statistics of all of its frames, and load that.

    Args:
        folders: datasets to merge, in this order.
        into: folder of the new dataset, which must not exist.
        splits: first episode and the one after the last, by name.
        layout: sizes and names of the task.

    Returns:
        All episodes, as :func:`dynmap_rl.data.load_dataset` returns them.
    """
    with quiet(), _without_cache():
        import datasets
        from lerobot.datasets.aggregate import aggregate_datasets
        from lerobot.datasets.io_utils import load_info, load_stats, write_info, write_stats

        # Not the user's cache, which would keep a copy of every shard.
        with _replaced(datasets.config, "HF_DATASETS_CACHE", str(into.with_name("cache.tmp"))):
            aggregate_datasets([LOCAL_ID] * len(folders), LOCAL_ID, folders, into, concatenate_data=False)
        info = load_info(into)
        info.splits = {name: f"{first}:{end}" for name, (first, end) in splits.items()}
        write_info(info, into)
        stats = load_stats(into) | _compute_stats(into, layout)
        write_stats({name: stats[name] for name in sorted(stats)}, into)
    return load_dataset(into, layout=layout)


def _to_columns(episodes: TensorDict, layout: Layout) -> dict[str, np.ndarray]:
    frames = episodes["pixels"].permute(0, 1, 3, 4, 2).split(layout.image_size, 3)
    columns = {
        **{f"{CAMERAS}{camera}": part for camera, part in zip(layout.cameras, frames, strict=True)},
        "observation.state": episodes["agent_pos"],
        "action": episodes["action"],
        "next.reward": episodes["next", "reward"],
        "next.done": episodes["next", "done"],
        "next.success": episodes["next", "is_success"],
        "disturbed": episodes["disturbed"],
        "expert_action": episodes["expert_action"],
        **{f"dynamics.{name}": values for name, values in episodes["dynamics"].items()},
    }
    return {name: values.numpy() for name, values in columns.items()}


def _compute_stats(root: Path, layout: Layout) -> dict[str, dict[str, np.ndarray]]:
    """Compute the statistics of all numbers at once, in float64.

    LeRobot's merging averages the quantiles of the episodes. A goal is constant in an episode: all of its quantiles
    would be its mean.
    """
    from lerobot.datasets.compute_stats import get_feature_stats

    info, features = read_info(root), make_features(layout)
    names = [name for name, feature in features.items() if feature["dtype"] != "image"]
    table = read_table(root, info, names)
    return {
        name: get_feature_stats(read_column(root, info, table, name).double().numpy(), axis=0, keepdims=False)
        for name in names
    }


@contextlib.contextmanager
def _images_in_memory():
    """Let LeRobot take image files from an episode's buffer in the place of paths of files."""
    from lerobot.datasets import compute_stats, dataset_writer

    def sample_images(files: list[dict]) -> np.ndarray:
        some = [files[i]["bytes"] for i in compute_stats.sample_indices(len(files))]
        frames = [decode_image(file, math.inf).transpose(2, 0, 1) for file in some]
        return np.stack([compute_stats.auto_downsample_height_width(frame) for frame in frames])

    with (
        _replaced(compute_stats, "sample_images", sample_images),
        _replaced(dataset_writer, "embed_images", lambda dataset: dataset),
    ):
        yield


@contextlib.contextmanager
def _without_cache():
    """Embed the images of an episode at once, and without the hashes that ``datasets`` takes of it for its cache.

    LeRobot embeds row by row.
    """
    from datasets import Dataset, arrow_dataset
    from datasets.fingerprint import generate_random_fingerprint
    from datasets.table import embed_table_storage
    from lerobot.datasets import io_utils

    def embed_images(dataset):
        table = embed_table_storage(dataset.data.table)
        return Dataset(table, info=dataset.info, split=dataset.split)

    with (
        _replaced(arrow_dataset, "generate_fingerprint", lambda dataset: generate_random_fingerprint()),
        _replaced(io_utils, "embed_images", embed_images),
    ):
        yield


@contextlib.contextmanager
def _replaced(module, name: str, value):
    """Set an attribute of a module until the end of the block."""
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)
