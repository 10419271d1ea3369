"""Writing of rollouts as LeRobot v3.0 datasets, and merging of such datasets."""

from __future__ import annotations

import contextlib
import io
from pathlib import Path

import numpy as np
from PIL import Image
from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.keys import CAMERAS

from ..decoding import decode_episodes
from .columns import compute_stats
from .quiet import quiet
from .reading import read_column, read_info, read_table

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
        episodes: ``[E, T]`` with the entries of :func:`dynmap_rl.data.recording.plans.run_plans` and ``disturbed`` bool
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
        for episode in range(len(columns["action"])):
            _fill_buffer(dataset, {name: values[episode] for name, values in columns.items()}, instruction)
            with _without_cache():
                dataset.save_episode()
        dataset.finalize()
    written = decode_episodes(folder, read_info(folder), layout)
    # LeRobot only logs a frame that could not be written.
    for key in ("pixels", "agent_pos", "action", "dynamics", "disturbed", "expert_action"):
        if not (written[key] == episodes[key]).all():
            raise OSError(f"{key} of {folder} must be as written, got other values; check the disk")


class _Images(list):
    """Image files of an episode, with their ``pixels`` uint8 ``[T, 3, H, W]``."""

    def __init__(self, frames: np.ndarray):
        from lerobot.datasets.utils import IMAGE_FILE_PATTERN

        super().__init__()
        self.pixels = frames.transpose(0, 3, 1, 2)
        for t, frame in enumerate(frames):
            file = io.BytesIO()
            # LeRobot's level 6 takes up to three times as long.
            Image.fromarray(frame).save(file, "PNG", compress_level=1)
            self.append({"bytes": file.getvalue(), "path": IMAGE_FILE_PATTERN.format(frame_index=t)})


def _fill_buffer(dataset, columns: dict[str, np.ndarray], instruction: str) -> None:
    """Give LeRobot a whole episode: its ``add_frame`` checks every value and writes every image to a file."""
    steps = len(columns["action"])
    buffer = dataset.writer.episode_buffer
    buffer |= {"size": steps, "task": [instruction] * steps, "frame_index": np.arange(steps)}
    buffer["timestamp"] = np.arange(steps) / dataset.fps
    for name, values in columns.items():
        if values.dtype == np.uint8:
            buffer[name] = _Images(values)
        else:  # LeRobot computes statistics in the buffer's precision, and float32 is not enough for variances
            buffer[name] = values.astype(np.float64) if values.dtype == np.float32 else values


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
        All episodes without their frames, otherwise as :func:`dynmap_rl.data.load_dataset` returns them.
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
    return decode_episodes(into, read_info(into), layout, pixels=False)


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
    info, features = read_info(root), make_features(layout)
    names = [name for name, feature in features.items() if feature["dtype"] != "image"]
    table = read_table(root, info, names)
    return {name: compute_stats(read_column(root, info, table, name).numpy()) for name in names}


@contextlib.contextmanager
def _without_cache():
    """Embed the images of an episode at once, and without the hashes that ``datasets`` takes of it for its cache.

    LeRobot embeds row by row, and reads image files for their statistics.
    """
    from datasets import Dataset, arrow_dataset
    from datasets.fingerprint import generate_random_fingerprint
    from datasets.table import embed_table_storage
    from lerobot.datasets import compute_stats, dataset_writer, io_utils

    def embed_images(dataset):
        table = embed_table_storage(dataset.data.table)
        return Dataset(table, info=dataset.info, split=dataset.split)

    def sample_images(files: _Images) -> np.ndarray:
        chosen = files.pixels[compute_stats.sample_indices(len(files))]
        frames = [compute_stats.auto_downsample_height_width(frame) for frame in chosen]
        return np.stack(frames, 1).swapaxes(0, 1)  # a channel's values side by side, for fast sums

    with (
        _replaced(compute_stats, "sample_images", sample_images),
        _replaced(arrow_dataset, "generate_fingerprint", lambda dataset: generate_random_fingerprint()),
        _replaced(dataset_writer, "embed_images", embed_images),  # of an episode
        _replaced(io_utils, "embed_images", embed_images),  # of a merged file
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
