"""Positions in the frames of a camera, for datasets without dynamics."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from dynmap_rl.envs.task import BODIES

from .flow import flow_velocity
from .format.frames import choose_camera, iterate_frames
from .format.reading import read_column, read_table, spans
from .motion import Motion
from .tracking import SORTS, WIDEST, Tracks, track_centroid, track_objects

BODY = "x", "y", "theta"
MOST = 250  # objects: their numbers are bytes


@dataclass(frozen=True)
class FrameSource:
    """How frames are turned into positions.

    Attributes:
        source: ``centroid`` (see :func:`dynmap_rl.data.tracking.track_centroid`), ``tracks`` (see
            :func:`dynmap_rl.data.tracking.track_objects`) or ``flow`` (tracks, and velocities by
            :func:`dynmap_rl.data.flow.flow_velocity`).
        column: the camera's column.
        objects: number of objects, for ``tracks`` and ``flow``.
        colors: colour of each object (RGB, 0 to 255); None tells them apart by themselves.
        threshold: smallest difference of a colour channel, 0 to 255, of a pixel that moves, and of two colours.
        sort: order of the objects, where no colours are given.
        point: whether the angles of ``tracks`` and ``flow`` are left out.
        width: width of the picture (m). Positions are then in m from its lower left corner, y up, and angles
            counterclockwise. Without it they are pixels of the full frame, y down, and angles clockwise.
    """

    source: str
    column: str
    objects: int = 1
    colors: tuple[tuple[int, int, int], ...] | None = None
    threshold: int = 30
    sort: str = "lowest"
    point: bool = False
    width: float | None = None

    @property
    def size(self) -> int:
        """Number of entries of an object."""
        return 2 if self.point or self.source == "centroid" else 3

    @property
    def names(self) -> list[str]:
        """Names of the entries of the position."""
        if self.source == "centroid":
            return ["x", "y"]
        return [f"object{n}_{name}" for n in range(1, self.objects + 1) for name in BODY[: self.size]]


def choose_view(
    root: Path,
    info: dict,
    source: str,
    planar: bool = False,
    *,
    camera: str | None = None,
    objects: int | None = None,
    colors: Sequence[str] | None = None,
    threshold: int = 30,
    sort: str = "lowest",
    point: bool = False,
    width: float | None = None,
) -> FrameSource:
    """Return how frames are read.

    Args:
        root: folder of the dataset, for messages.
        info: content of its ``meta/info.json``.
        source: ``centroid``, ``tracks`` or ``flow``.
        planar: whether the dataset is a recording of cart and block, whose picture is 1 m wide and shows two objects.
        camera: the camera's column; by default the first one.
        objects: see :class:`FrameSource`, also for the next; by default two for a planar recording, otherwise one.
        colors: colour of each object, a name or ``#rrggbb``, instead of ``objects`` and ``sort``.
        threshold: smallest difference of a pixel that moves.
        sort: order of the objects.
        point: leave the angles out.
        width: width of the picture (m); by default 1 for a planar recording, otherwise None.

    Raises:
        ValueError: an argument is wrong.
    """
    if source == "centroid" and (objects is not None or colors is not None or point):
        raise ValueError(
            "--objects, --colors and --point have no effect with --source centroid; leave them out"
        )
    if colors is not None:
        if objects is not None or sort != "lowest":
            raise ValueError("--objects and --sort have no effect with --colors; leave them out")
        colors = tuple(map(_parse_color, colors))
        if not colors or len(set(colors)) < len(colors):
            raise ValueError("--colors must be a different colour for each object")
    objects = len(colors) if colors else objects
    if objects is None:
        objects = len(BODIES) // 3 if planar and source != "centroid" else 1
    if not 1 <= objects <= MOST:
        raise ValueError(f"--objects must be 1 to {MOST}, got {objects}")
    if not 0 < threshold < 256:
        raise ValueError(f"--threshold must be 1 to 255, got {threshold}")
    if sort not in SORTS:
        raise ValueError(f"--sort must be one of {', '.join(SORTS)}, got {sort!r}")
    if planar and width not in (None, 1):
        raise ValueError(f"--width must be 1 for a recording of cart and block, got {width}")
    width = 1.0 if planar else width
    if width is not None and not 0 < width < math.inf:
        raise ValueError(f"--width must be above 0, got {width}")
    column = choose_camera(root, info, camera)
    return FrameSource(source, column, objects, colors, threshold, sort, point, width)


def _parse_color(text: str) -> tuple[int, int, int]:
    from PIL import ImageColor

    try:
        red, green, blue = ImageColor.getrgb(text.strip())
    except ValueError as error:
        raise ValueError(f"--colors must be names or #rrggbb, such as #1c1c1c,red, got {text!r}") from error
    return red, green, blue


def read_motion(
    root: Path, info: dict, camera: FrameSource, only: Collection[int] | None = None
) -> Iterator[tuple[int, Motion]]:
    """Iterate over the episodes' motions as a camera sees them.

    Args:
        root: folder of the dataset.
        info: content of its ``meta/info.json``.
        camera: source and its settings.
        only: the episodes that are read; by default all.

    Raises:
        ValueError: a file is damaged, or what should be tracked is not found; the message names the episode.
    """
    table, failed = read_table(root, info, ["timestamp"]), {}
    time = read_column(root, info, table, "timestamp", np.float64).numpy()[:, 0]
    rows = dict(spans(table["episode_index"].to_numpy()))
    episodes = iterate_frames(root, info, camera.column, widest=WIDEST, only=only)
    count = info.get("total_episodes") if only is None else len(only)
    for episode, frames, factor in tqdm(episodes, "tracking", count, leave=False):
        try:
            yield episode, measure(frames, factor, camera, time[rows[episode]])
        except ValueError as error:
            failed.setdefault(str(error), []).append(episode)
    if failed:
        found = "; ".join(f"in {_name_episodes(e)} {text}" for text, e in failed.items())
        some = sum(map(len, failed.values())) < (len(rows) if only is None else len(only))
        advice = "; or delete these episodes (lerobot-edit-dataset)" if some else ""
        raise ValueError(f"{root}: {found}{advice}")


def _name_episodes(episodes: list[int]) -> str:
    """Return episodes as text."""
    return f"episode{'s' * (len(episodes) > 1)} {', '.join(map(str, episodes))}"


def measure(frames: np.ndarray, factor: Sequence[float], camera: FrameSource, time: np.ndarray) -> Motion:
    """Measure the motion in one episode.

    Args:
        frames: uint8 ``[T, height, width, 3]``.
        factor: ratios of the full width and height to those of the frames, ``[2]``.
        camera: source and its settings.
        time: times of the frames ``[T]`` (s).

    Raises:
        ValueError: what should be tracked is not found.
    """
    (count, height, width), size = frames.shape[:3], camera.size
    place, scale = _scale(height, width, factor, camera.width, size)
    if camera.source == "centroid":
        centroid, found = track_centroid(frames, camera.threshold)
        return Motion(place(centroid), [], found=found[:, None])
    tracks = track(frames, camera)
    position = place(tracks.pose[..., :size]).reshape(count, -1)
    flow = (flow_velocity(frames, tracks, time)[..., :size] * scale).reshape(count, -1)
    angles = [] if camera.point else list(range(2, position.shape[1], 3))
    used = {"velocity" if camera.source == "flow" else "other": flow}
    return Motion(position, angles, found=tracks.found, tracks=tracks, **used)


def track(frames: np.ndarray, camera: FrameSource) -> Tracks:
    """Track the objects of a camera in frames uint8 ``[T, height, width, 3]``."""
    return track_objects(frames, camera.objects, camera.threshold, camera.sort, camera.colors)


def _scale(height: int, width: int, factor: Sequence[float], metres: float | None, size: int):
    """Return the map from pixels of reduced frames to positions, and the factors of differences."""
    middle = np.array([0.5, 0.5, 0.0])[:size]  # of a pixel
    scale, origin = np.array([*factor, 1.0])[:size], -middle
    if metres is not None:
        pixel = metres / (width * factor[0])  # of the full frame
        scale, origin = scale * np.array([pixel, -pixel, -1.0])[:size], np.zeros(size)
        origin[1] = pixel * height * factor[1]
    return lambda pose: (pose + middle) * scale + origin, scale
