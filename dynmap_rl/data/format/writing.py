"""Writing of rollouts as LeRobot v3.0 datasets, and merging of such datasets."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
from tensordict import TensorDict

from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS
from dynmap_rl.keys import CAMERA

from ..demonstrations import load_dataset
from .quiet import quiet
from .reading import read_column, read_info, read_table

LOCAL_ID = "dynmap_rl/recording"  # LeRobot needs an id; it is not stored
FPS = round(1 / CONTROL_DT)

POSE = ["cart_x", "cart_y", "cart_theta"]
BODIES = [*POSE, "block_x", "block_y", "block_theta"]
FEATURES = {
    CAMERA: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
    "observation.state": {"dtype": "float32", "shape": (5,), "names": [*POSE, "goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (3,), "names": ["delta_x", "delta_y", "delta_theta"]},
    "expert_action": {"dtype": "float32", "shape": (3,), "names": ["delta_x", "delta_y", "delta_theta"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": ["reward"]},
    "next.done": {"dtype": "bool", "shape": (1,), "names": ["done"]},
    "next.success": {"dtype": "bool", "shape": (1,), "names": ["success"]},
    "disturbed": {"dtype": "bool", "shape": (1,), "names": ["disturbed"]},
    "dynamics.position": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.velocity": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.acceleration": {"dtype": "float32", "shape": (6,), "names": BODIES},
}


def write_episodes(folder: Path, episodes: TensorDict, instruction: str) -> None:
    """Write rollouts as a new dataset, and read it back.

    Args:
        folder: folder of the dataset, which must not exist.
        episodes: ``[E, 120]`` with the entries of :func:`dynmap_rl.data.recording.plans.roll_out` and ``disturbed`` bool
            ``[E, 120, 1]``.
        instruction: the task in one sentence.

    Raises:
        OSError: the folder does not hold what was written.
    """
    columns = _to_columns(episodes)
    with quiet():
        from lerobot.datasets import LeRobotDataset

        dataset = LeRobotDataset.create(
            LOCAL_ID, FPS, FEATURES, root=folder, robot_type="dynmap_cart", use_videos=False
        )
        for episode in range(len(columns["action"])):
            for t in range(EPISODE_STEPS):
                frame = {name: values[episode, t] for name, values in columns.items()}
                dataset.add_frame({**frame, "task": instruction})
            # LeRobot computes statistics in the buffer's precision, and float32 is not enough for variances.
            buffer = dataset.writer.episode_buffer
            for name in columns:
                if FEATURES[name]["dtype"] == "float32":
                    buffer[name] = [value.astype(np.float64) for value in buffer[name]]
            with _embedding_in_batches():
                dataset.save_episode()
        dataset.finalize()
    written = load_dataset(folder)
    # LeRobot only logs a frame that could not be written.
    for key in ("pixels", "agent_pos", "action", "dynamics", "disturbed", "expert_action"):
        if not (written[key] == episodes[key]).all():
            raise OSError(f"{key} of {folder} must be as written, got other values; check the disk")


def merge_datasets(folders: list[Path], into: Path, splits: dict[str, list[int]]) -> TensorDict:
    """Merge datasets into a new one, with statistics of all of its frames, and load that.

    Args:
        folders: datasets to merge, in this order.
        into: folder of the new dataset, which must not exist.
        splits: first episode and the one after the last, by name.

    Returns:
        All episodes, as :func:`dynmap_rl.data.load_dataset` returns them.
    """
    with quiet(), _embedding_in_batches():
        import datasets
        from lerobot.datasets.aggregate import aggregate_datasets
        from lerobot.datasets.io_utils import load_info, load_stats, write_info, write_stats

        # Not the user's cache, which would keep a copy of every shard.
        with _replaced(datasets.config, "HF_DATASETS_CACHE", str(into.with_name("cache.tmp"))):
            aggregate_datasets([LOCAL_ID] * len(folders), LOCAL_ID, folders, into, concatenate_data=False)
        info = load_info(into)
        info.splits = {name: f"{first}:{end}" for name, (first, end) in splits.items()}
        write_info(info, into)
        stats = load_stats(into) | _compute_stats(into)
        write_stats({name: stats[name] for name in sorted(stats)}, into)
    return load_dataset(into)


def _to_columns(episodes: TensorDict) -> dict[str, np.ndarray]:
    columns = {
        CAMERA: episodes["pixels"].permute(0, 1, 3, 4, 2),
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


def _compute_stats(root: Path) -> dict[str, dict[str, np.ndarray]]:
    """Compute the statistics of all numbers at once, in float64.

    LeRobot's merging averages the quantiles of the episodes. A goal is constant in an episode: all of its quantiles
    would be its mean.
    """
    from lerobot.datasets.compute_stats import get_feature_stats

    info, names = read_info(root), [name for name in FEATURES if name != CAMERA]
    table = read_table(root, info, names)
    return {
        name: get_feature_stats(read_column(root, info, table, name).double().numpy(), axis=0, keepdims=False)
        for name in names
    }


@contextlib.contextmanager
def _embedding_in_batches():
    """Embed the images of an episode in one batch, in half the time that LeRobot takes row by row."""
    from datasets.table import embed_table_storage
    from lerobot.datasets import dataset_writer, io_utils

    def embed_images(dataset):
        embedded = dataset.with_format("arrow").map(embed_table_storage, batched=True)
        return embedded.with_format(**dataset.format)

    with (
        _replaced(io_utils, "embed_images", embed_images),
        _replaced(dataset_writer, "embed_images", embed_images),
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
