"""Tracking of moving objects in frames: positions for datasets without a state.

The camera must stand still and the light must not change. What moves is found as the difference from a background, the
median of the episode. Depth is not measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from .segmentation import faintest, find_colors, find_moving, split_colors

SAMPLES = 51  # frames whose median is the background; odd, so that every median is a value of a frame
WIDEST = 160  # pixels that frames are reduced to, as the centroid is finer than a pixel
SORTS = "lowest", "largest", "brightest"


@dataclass(frozen=True)
class Tracks:
    """Tracks of N objects in an episode of T frames.

    Attributes:
        pose: ``[T, N, 3]``, x (right) and y (down) of the centre in pixels, and the angle (rad, clockwise in the
            picture); interpolated where the object is not found.
        found: bool ``[T, N]``.
        area: pixels of the object, ``[T, N]``; 0 where it is not found.
        cut: bool ``[T, N]``, whether the object touches the border of the picture.
        labels: uint8 ``[T, height, width]``, number of the object of a pixel from 1 on, 0 elsewhere.
        elongation: ratio of the axes of each object, ``[N]``, the median over the frames.
        color: mean colour of each object (RGB, 0 to 255), ``[N, 3]``.
        moving: share of the pixels that ever differ from the background.
    """

    pose: np.ndarray
    found: np.ndarray
    area: np.ndarray
    cut: np.ndarray
    labels: np.ndarray
    elongation: np.ndarray
    color: np.ndarray
    moving: float


def track_centroid(frames: np.ndarray, threshold: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Compute the centroid of all pixels that differ from the episode's background.

    The background is the median of frames at equal distances in the total change of the picture, not in time, so that an
    object at rest for most of an episode does not become background. Pixels weigh by their difference. Specks smaller
    than 3 x 3 pixels are left out. The centroid of a frame without a difference is interpolated.

    The centroid is one point for all that moves: arm, object and shadows together. An object that never moves is not
    found. A place where an object stays for most of the change counts as moving when the object has left it.

    Args:
        frames: frames of one episode, uint8 ``[T, height, width, 3]``.
        threshold: smallest difference of a colour channel, 0 to 255, of a pixel that moves.

    Returns:
        ``[T, 2]``, x (right) and y (down) in pixels, float64, and whether something was found, bool ``[T]``.

    Raises:
        ValueError: nothing moves, or specks only.
    """
    background, specks = _background(frames, threshold), False
    centroids = np.full((len(frames), 2), np.nan)
    for t, frame in enumerate(frames):
        difference = _changed(frame, background, threshold)
        specks = specks or difference.any()
        mask = cv2.morphologyEx((difference > 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        moments = cv2.moments(difference * mask)
        if moments["m00"]:
            centroids[t] = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    found = ~np.isnan(centroids[:, 0])
    if not found.any():
        small = "nothing larger than a speck moves: no 3 x 3 pixels differ; film from nearer, or use --source tracks"
        raise ValueError(small if specks else _still(threshold))
    return fill_gaps(centroids, found), found


def track_objects(
    frames: np.ndarray,
    objects: int = 1,
    threshold: int = 30,
    sort: str = "lowest",
    colors: Sequence[tuple[int, int, int]] | None = None,
) -> Tracks:
    """Segment what moves into objects, and measure centre and angle of each in every frame.

    A pixel belongs to what moves if its colour is more frequent among pixels that differ from the background than
    among pixels that never do. So an object is found where it rests, and its place in the background is not taken
    for an object. Several objects are told apart by their colours (k-means over the episode; colours that differ by less
    than ``threshold`` are one). Colours that are seen in less than a tenth of the frames, or that move less, are left
    out. The object is the largest connected region of its colour; centre and angle are its moments.

    An object of several colours needs ``objects`` = 1, and objects of one colour are not told apart.

    With ``colors``, a pixel belongs to the object whose colour is nearest, if no channel differs by ``threshold`` or more.
    Regions in which nothing moves in the episode are left out, unless the object has no other. Other things may move too,
    such as an arm.

    The angle is that of the longest axis, which has no direction: it begins within a quarter of a turn of 0 in every
    episode. It means little for an object as wide as tall.

    Args:
        frames: frames of one episode, uint8 ``[T, height, width, 3]``.
        objects: number of objects N.
        threshold: smallest difference of a colour channel, 0 to 255, of a pixel that moves.
        sort: order of the objects: ``lowest`` in the picture first, at the first frame; ``largest`` or ``brightest``
            first. The order must be the same in all episodes.
        colors: colour of each object (RGB, 0 to 255), instead of ``objects`` and ``sort``.

    Raises:
        ValueError: fewer objects move, a colour is not seen, or no pixel is at rest.
    """
    background = _background(frames, threshold)
    changed = np.stack([_changed(frame, background, threshold) > 0 for frame in frames])
    ever = changed.any(0)
    if not ever.any():
        raise ValueError(_still(threshold))
    if ever.all():
        raise ValueError(
            "every pixel changes; the camera must stand still and the light must not change, or raise --threshold"
        )
    if colors is None:
        labels = split_colors(frames, find_moving(frames, changed, ever), objects, threshold)
    else:
        labels, objects = find_colors(frames, ever, colors, threshold), len(colors)
    regions = [[_measure(frame_labels, n) for n in range(1, objects + 1)] for frame_labels in labels]
    area = np.array([[region[1] for region in row] for row in regions], float)
    found = area >= np.array([faintest(column) for column in area.T])
    if missing := np.flatnonzero(~found.any(0)).tolist():
        if colors is None:
            raise ValueError(f"fewer than {objects} objects move; use fewer --objects")
        color = "#{:02x}{:02x}{:02x}".format(*colors[missing[0]])
        raise ValueError(
            f"no object of the colour {color} is seen; read its colour off a frame, or raise --threshold, "
            f"got {threshold}"
        )
    pose = np.array([[region[0] for region in row] for row in regions])
    elongation = np.array([[region[3] for region in row] for row in regions])
    elongation = _medians(elongation, found)
    cut = np.array([[region[2] for region in row] for row in regions]) & found
    for n in range(objects):
        seen = found[:, n]
        pose[seen, n, 2] = np.unwrap(pose[seen, n, 2], period=np.pi)  # an axis has no direction
        pose[:, n] = fill_gaps(pose[:, n], found[:, n])
    color = np.array([frames[labels == n + 1].mean(0) for n in range(objects)])
    order = range(objects) if colors else _order(sort, pose, area, found, color)
    numbers = np.zeros(objects + 1, np.uint8)
    numbers[np.asarray(order) + 1] = np.arange(1, objects + 1)
    return Tracks(
        pose[:, order],
        found[:, order],
        (area * found)[:, order],
        cut[:, order],
        numbers[labels],
        elongation[order],
        color[order],
        float(ever.mean()),
    )


def fill_gaps(values: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Interpolate values ``[T, D]`` linearly where they were not found; the ends repeat the nearest value."""
    time = np.arange(len(values))
    return np.stack([np.interp(time, time[found], column[found]) for column in values.T], 1)


def _measure(labels: np.ndarray, n: int) -> tuple[tuple[float, float, float], int, bool, float]:
    """Return pose (pixels, rad), area, contact with the border and elongation of object n's largest region; clear others."""
    mask = labels == n
    count, regions, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    if count == 1:
        return (0.0, 0.0, 0.0), 0, False, 1.0
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    labels[mask & (regions != largest)] = 0
    moments = cv2.moments((regions == largest).astype(np.uint8), binaryImage=True)
    x, y = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    both, apart = moments["mu20"] + moments["mu02"], moments["mu20"] - moments["mu02"]
    angle, apart = 0.5 * np.arctan2(2 * moments["mu11"], apart), np.hypot(2 * moments["mu11"], apart)
    left, top, width, height, area = stats[largest]
    cut = left == 0 or top == 0 or left + width == mask.shape[1] or top + height == mask.shape[0]
    return (x, y, angle), int(area), bool(cut), float(np.sqrt((both + apart) / max(both - apart, 1e-9)))


def _order(sort: str, pose, area, found, color) -> list[int]:
    values = {
        "lowest": pose[0, :, 1],
        "largest": _medians(area, found),
        "brightest": color.mean(1),
    }[sort]
    return np.argsort(-values, kind="stable").tolist()


def _medians(values: np.ndarray, found: np.ndarray) -> np.ndarray:
    return np.array([np.median(column[seen]) for column, seen in zip(values.T, found.T, strict=True)])


def _background(frames: np.ndarray, threshold: int) -> np.ndarray:
    change = [_changed(a, b, threshold).mean() for a, b in pairwise(frames)]
    travelled = np.cumsum([0.0, *change])
    samples = np.searchsorted(travelled, np.linspace(0, travelled[-1], SAMPLES))
    return np.median(frames[samples.clip(max=len(frames) - 1)], axis=0).astype(np.uint8)


def _changed(frame: np.ndarray, other: np.ndarray, threshold: int) -> np.ndarray:
    """Return the largest difference of two frames over the channels, and 0 where it is below the threshold."""
    return cv2.threshold(cv2.absdiff(frame, other).max(2), threshold, 0, cv2.THRESH_TOZERO)[1]


def _still(threshold: int) -> str:
    return f"nothing moves: no pixel differs by more than {threshold} of 255; use a lower --threshold"
