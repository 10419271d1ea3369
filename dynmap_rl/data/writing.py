"""Rollouts as LeRobot v3.0 files: the columns, the writing, the merging, and the way to the hub."""

from __future__ import annotations

import contextlib
import io
import logging
from pathlib import Path
from unittest import mock

import numpy as np
from tensordict import TensorDict

from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS

from .loading import CAMERA, META, NEEDED, OPTIONAL, load_dataset, load_meta

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
DESCRIPTION = """\
{kind} of the task `{task}` of dynmap_rl, for world models that are supervised on the dynamics of the scene:
"{instruction}" A cart carries a free-standing block over a scene of 1 m x 1 m: {episodes} episodes of {steps} steps
at {fps} Hz, simulated with PyMunk, drawn with pygame, made by state-based PPO experts: {selection}.

| column | shape | content |
|---|---|---|
| `observation.images.front` | 64, 64, 3 | the frame, lossless |
| `observation.state` | 5 | commanded cart pose x, y, theta (m, m, rad) and goal x, y (m) |
| `action` | 3 | change of the commanded cart pose in one step (m, m, rad) |
| `next.reward`, `next.done`, `next.success` | 1 | after the action |
| `dynamics.position` | 6 | cart x, y, theta, block x, y, theta (m, m, rad) |
| `dynamics.velocity` | 6 | its rate, as the simulator has it (m/s, rad/s) |
| `dynamics.acceleration` | 6 | change of velocity since the last step over {dt} s (m/s^2, rad/s^2); 0 at the start |

`{meta}` holds the splits ({splits}), constants for normalisation, and scene, seed and expert of every episode."""


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


def push_dataset(root: str | Path, repo_id: str) -> None:
    """Upload a recording to the Hugging Face hub, with a card and the tag by which LeRobot finds it.

    Raises:
        ValueError: the folder is no recording of ours.
        OSError: the hub refuses it or cannot be reached.
    """
    meta = load_meta(root)
    with quiet():
        from lerobot.datasets import LeRobotDataset

        try:
            dataset = LeRobotDataset(repo_id, root=root, video_backend="pyav")
            description = _describe(meta, instruction=dataset.meta.tasks.index[0])
            dataset.push_to_hub(tags=["dynamics"], license="mit", dataset_description=description)
        except Exception as error:  # of the hub's client, or of the HTTP library below it
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise OSError(
                f"cannot push {root} to {repo_id} ({reason}); check the name, the network, and `hf auth login`"
            ) from error


def _describe(meta: dict, instruction: str) -> str:
    exploring = meta["kind"] == "exploration"
    return DESCRIPTION.format(
        kind=meta["kind"].capitalize(),
        task=meta["task"],
        instruction=instruction,
        episodes=len(meta["episodes"]),
        steps=EPISODE_STEPS,
        fps=FPS,
        selection="with noise and detours" if exploring else "successful episodes, most with pushes",
        dt=CONTROL_DT,
        meta=META,
        splits=", ".join(f"{name} {first} to {end - 1}" for name, (first, end) in meta["splits"].items()),
    )


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
