"""Reading of the frames of any LeRobot v3.0 dataset, images or videos, one episode after the other."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa

from dynmap_rl.utils.hub import first_line

from .images import decode_image, image_files
from .reading import read_file, spans

TOLERANCE = 1e-4  # s between a timestamp and the video's frame, as in LeRobot
PLACE = "chunk_index", "file_index", "from_timestamp"  # place of an episode in the video files
BLOCK = 100  # frames decoded at a time, as a whole episode in full size may not fit into memory


def choose_camera(root: Path, info: dict, camera: str | None = None) -> str:
    """Return the camera's column, by default the first camera of the dataset; depth maps are no cameras.

    Args:
        root: folder of the dataset, for messages.
        info: content of its ``meta/info.json``.
        camera: name of the column, or None.

    Raises:
        ValueError: the dataset has no camera, or no camera of that name.
    """
    cameras = list_cameras(info)
    if not cameras:
        raise ValueError(
            f"{root} must have an image or video column with colours, got none; choose another dataset"
        )
    if camera not in (None, *cameras):
        raise ValueError(f"--camera must be one of {', '.join(cameras)}, got {camera!r}")
    return camera or cameras[0]


def list_cameras(info: dict) -> list[str]:
    """Return the columns of the cameras of a dataset; depth maps are no cameras."""
    return [n for n, f in info["features"].items() if f["dtype"] in ("image", "video") and not _is_depth(f)]


def _is_depth(feature: dict) -> bool:
    """Return whether a feature is marked as a depth map, in the places where LeRobot writes it."""
    notes = (feature.get("info") or {}) | (feature.get("video_info") or {})
    return bool(notes.get("is_depth_map") or notes.get("video.is_depth_map"))


def iterate_frames(
    root: Path,
    info: dict,
    camera: str,
    size: tuple[int, int] | None = None,
    widest: int | None = None,
    only: Collection[int] | None = None,
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Iterate over the episodes' frames, in order of time.

    Frames are reduced with ``cv2.INTER_AREA``, which averages, and enlarged with ``cv2.INTER_LINEAR``.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``.
        camera: column of the frames.
        size: width and height that frames are resized to, whatever their own aspect.
        widest: width that wider frames are reduced to, in place of ``size``.
        only: the episodes that are read; by default all.

    Yields:
        The episode's index, its frames uint8 ``[T, height, width, 3]`` (RGB), and the ratios of stored to returned width and
        height, ``[2]``.

    Raises:
        ValueError: a file is damaged; the message names the file.
    """
    video = info["features"][camera]["dtype"] == "video"
    episodes = _read_episodes(root, camera) if video else {}
    columns = ["episode_index", "index", "timestamp", *([] if video else [camera])]
    shape = info["features"][camera]["shape"]
    largest = math.prod(shape) // min(shape)  # pixels, without the channels
    for file in sorted((root / "data").glob("*/*.parquet")):
        if only is not None and not set(only) & set(
            read_file(file, columns[:1])["episode_index"].to_pylist()
        ):
            continue
        table = read_file(file, columns)
        if (np.diff(index := table["index"].to_numpy()) < 0).any():  # the order of time, as in read_table
            table = table.take(np.argsort(index))
        for episode, span in spans(table["episode_index"].to_numpy()):
            if only is not None and episode not in only:
                continue
            rows = table.slice(span.start, span.stop - span.start)
            blocks = (
                _decode_video(root, info, episodes, camera, rows)
                if video
                else _decode(file, camera, rows, largest)
            )
            frames = []
            for block in blocks:
                height, width = block[0].shape[:2]
                frames += [_resize(frame, size or _reduced(frame, widest)) for frame in block]
            if len(sizes := {frame.shape[:2] for frame in frames}) > 1:
                raise ValueError(
                    f"{file}: frames of episode {episode} must have one size, got {sorted(sizes)}; restore the dataset"
                )
            yield episode, np.stack(frames), np.divide([width, height], frames[0].shape[1::-1])


def _read_episodes(root: Path, camera: str) -> dict[int, dict]:
    """Read the place of every episode in the video files."""
    files = sorted((root / "meta" / "episodes").glob("*/*.parquet"))
    names = ["episode_index", *(f"videos/{camera}/{key}" for key in PLACE)]
    return {row["episode_index"]: row for file in files for row in read_file(file, names).to_pylist()}


def _decode(file: Path, camera: str, rows: pa.Table, largest: int) -> Iterator[list[np.ndarray]]:
    images = image_files(file, camera, rows[camera])
    for start in range(0, len(images), BLOCK):
        block = []
        for row in range(start, min(start + BLOCK, len(images))):
            try:
                block.append(decode_image(images[row].as_buffer(), largest))
            except ValueError as error:
                episode = rows["episode_index"][0].as_py()
                raise ValueError(
                    f"{file}: frame {row} of episode {episode} {error}; restore the dataset"
                ) from error
        yield block


def _decode_video(
    root: Path, info: dict, episodes: dict, camera: str, rows: pa.Table
) -> Iterator[np.ndarray]:
    from .quiet import quiet

    with quiet():
        from lerobot.datasets.video_utils import decode_video_frames

    try:
        episode = episodes[rows["episode_index"][0].as_py()]
        chunk, number, start = (episode[f"videos/{camera}/{key}"] for key in PLACE)
        path = Path(info["video_path"].format(video_key=camera, chunk_index=chunk, file_index=number))
        times = start + rows["timestamp"].to_numpy().astype(np.float64)
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise ValueError(
            f"{root} must have the place of its videos in meta, got none that can be read ({error}); restore the dataset"
        ) from error
    if path.is_absolute() or ".." in path.parts:
        raise ValueError(f"video_path of {root} must be inside the dataset, got {path}; restore the dataset")
    path = root / path
    for start in range(0, len(times), BLOCK):
        some = times[start : start + BLOCK].tolist()
        try:
            # PyAV comes with its own FFmpeg; torchcodec needs the system's.
            frames = decode_video_frames(path, some, TOLERANCE, backend="pyav", return_uint8=True)
        except Exception as error:  # LeRobot and FFmpeg below it raise many kinds
            reason = first_line(error)
            raise ValueError(
                f"{path} cannot be decoded ({reason}); restore the dataset, and see that its timestamps are those of the "
                "video's frames"
            ) from error
        yield frames.permute(0, 2, 3, 1).numpy()


def join_views(views: Sequence[np.ndarray], image_size: int = 64) -> np.ndarray:
    """Resize the pictures of a robot's cameras as for training, and join them side by side.

    Args:
        views: a picture of each camera, uint8 ``[height, width, 3]`` (RGB), in the order of ``--camera``.
        image_size: S, side of the frames of the training.

    Returns:
        uint8 ``[S, cameras * S, 3]``, the frame that :class:`dynmap_rl.modules.RobotActor` takes.

    Raises:
        ValueError: a picture has another form.
    """
    for view in map(np.asarray, views):
        if view.dtype != np.uint8 or view.ndim != 3 or view.shape[-1] != 3 or not view.size:
            raise ValueError(
                f"views must be uint8 pictures [height, width, 3], got {view.dtype} {list(view.shape)}; of a float tensor "
                "[3, height, width] in 0..1, give (255 * x).byte().permute(1, 2, 0).numpy()"
            )
    return np.concatenate([_resize(view, (image_size, image_size)) for view in views], 1)


def _reduced(frame: np.ndarray, widest: int | None) -> tuple[int, int]:
    height, width = frame.shape[:2]
    factor = 1 if widest is None else min(1, widest / width)
    return round(width * factor), max(1, round(height * factor))


def _resize(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    height, width = frame.shape[:2]
    if size == (width, height):
        return frame
    reduced = cv2.resize(frame, (min(size[0], width), min(size[1], height)), interpolation=cv2.INTER_AREA)
    return cv2.resize(reduced, size, interpolation=cv2.INTER_LINEAR)
