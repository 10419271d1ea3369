"""Rollouts as LeRobot v3.0 files: the columns, the writing, the merging."""

from __future__ import annotations

import contextlib
import io
import logging
from pathlib import Path
from unittest import mock

import numpy as np
from tensordict import TensorDict

from ..demonstrations import CAMERA, NEEDED, OPTIONAL, load_dataset
from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS

LOCAL_ID = "dynmap_rl/recording"  # LeRobot wants an id; it is stored nowhere
FPS = round(1 / CONTROL_DT)

POSE = ["cart_x", "cart_y", "cart_theta"]
BODIES = [*POSE, "block_x", "block_y", "block_theta"]
FEATURES = {
    CAMERA: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
    "observation.state": {"dtype": "float32", "shape": (5,), "names": [*POSE, "goal_x", "goal_y"]},
    "action": {"dtype": "float32", "shape": (3,), "names": ["delta_x", "delta_y", "delta_theta"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": ["reward"]},
    "next.done": {"dtype": "bool", "shape": (1,), "names": ["done"]},
    "next.success": {"dtype": "bool", "shape": (1,), "names": ["success"]},
    "dynamics.position": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.velocity": {"dtype": "float32", "shape": (6,), "names": BODIES},
    "dynamics.acceleration": {"dtype": "float32", "shape": (6,), "names": BODIES},
}


def write_episodes(folder: Path, episodes: TensorDict, instruction: str) -> None:
    """Write rollouts ``[E, T]`` (see ``demonstrations.roll_out``) as a new dataset, and read it back.

    Raises:
        OSError: the disk does not hold what was written.
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
            # Statistics are computed in the buffer's precision, and float32 is not enough for variances.
            buffer = dataset.writer.episode_buffer
            for name in columns:
                if FEATURES[name]["dtype"] == "float32":
                    buffer[name] = [value.astype(np.float64) for value in buffer[name]]
            with _embedding_in_batches():
                dataset.save_episode()
        dataset.finalize()
    written = load_dataset(folder)
    # LeRobot only logs that a frame could not be written.
    for key in ("pixels", "agent_pos", "action", "dynamics"):
        if not (written[key] == episodes[key]).all():
            raise OSError(f"{folder} does not hold the {key} that were written to it")


def merge_datasets(folders: list[Path], into: Path, splits: dict[str, list[int]]) -> TensorDict:
    """Merge datasets into a new one, with statistics of all of its frames, and read that.

    Args:
        splits: name to first episode and the one after the last.

    Returns:
        All episodes, as :func:`load_dataset` returns them.
    """
    with quiet(), _embedding_in_batches():
        import datasets
        from lerobot.datasets import LeRobotDataset
        from lerobot.datasets.aggregate import aggregate_datasets
        from lerobot.datasets.io_utils import load_info, write_info, write_stats

        # Not the user's cache: a copy of every shard would stay in it.
        cache = str(into.with_name("cache.tmp"))
        with mock.patch.object(datasets.config, "HF_DATASETS_CACHE", cache):
            aggregate_datasets([LOCAL_ID] * len(folders), LOCAL_ID, folders, into, concatenate_data=False)
            dataset = LeRobotDataset(LOCAL_ID, root=into, video_backend="pyav")
        info = load_info(into)
        info.splits = {name: f"{first}:{end}" for name, (first, end) in splits.items()}
        write_info(info, into)
        episodes = load_dataset(into)
        stats = dataset.meta.stats | _compute_stats(episodes)
        write_stats({name: stats[name] for name in sorted(stats)}, into)
    return episodes


def _to_columns(episodes: TensorDict) -> dict[str, np.ndarray]:
    columns = {
        CAMERA: episodes["pixels"].permute(0, 1, 3, 4, 2),
        "observation.state": episodes["agent_pos"],
        "action": episodes["action"],
        "next.reward": episodes["next", "reward"],
        "next.done": episodes["next", "done"],
        "next.success": episodes["next", "is_success"],
        **{f"dynamics.{name}": values for name, values in episodes["dynamics"].items()},
    }
    return {name: values.numpy() for name, values in columns.items()}


def _compute_stats(episodes: TensorDict) -> dict[str, dict[str, np.ndarray]]:
    """Of all numbers at once, in float64.

    LeRobot's merging averages the quantiles of the episodes: those of a goal, which is constant in an episode, would
    all be its mean.
    """
    from lerobot.datasets.compute_stats import get_feature_stats

    return {
        name: get_feature_stats(episodes[key].flatten(0, 1).double().numpy(), axis=0, keepdims=False)
        for key, name in (NEEDED | OPTIONAL).items()
    }


@contextlib.contextmanager
def _embedding_in_batches():
    """LeRobot puts the images of an episode into the table row by row; all at once takes half the time."""
    from datasets.table import embed_table_storage
    from lerobot.datasets import dataset_writer, io_utils

    def embed_images(dataset):
        embedded = dataset.with_format("arrow").map(embed_table_storage, batched=True)
        return embedded.with_format(**dataset.format)

    with (
        mock.patch.object(io_utils, "embed_images", embed_images, create=True),
        mock.patch.object(dataset_writer, "embed_images", embed_images, create=True),
    ):
        yield


@contextlib.contextmanager
def quiet():
    """Hold back progress bars and notes of LeRobot and datasets, above all the page on missing video decoders."""
    import datasets

    disabled, bars = logging.root.manager.disable, datasets.are_progress_bars_disabled()
    logging.disable(logging.WARNING)
    datasets.disable_progress_bars()
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        logging.disable(disabled)
        if not bars:
            datasets.enable_progress_bars()
