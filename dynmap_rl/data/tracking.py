"""Tracking of moving objects in frames: positions for datasets without a state."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

SAMPLES = 51  # frames whose median is the background; odd, so that every median is a value of a frame
WIDEST = 160  # pixels that frames are reduced to, as the centroid is finer than a pixel


def track_centroid(frames: np.ndarray, threshold: int = 30) -> np.ndarray:
    """Compute the centroid of all pixels that differ from the episode's background.

    The background is the median of frames at equal distances in the total change of the picture, not in time, so that an
    object at rest for most of an episode does not become background. Pixels weigh by their difference. Specks smaller
    than 3 x 3 pixels are left out. A frame without a difference repeats the last centroid, or the first one to come.

    The centroid is one point for all that moves: arm, object and shadows together. The camera must stand still and the
    light must not change. An object that never moves is not found. A place where an object stays for most of the change
    counts as moving when the object has left it. Depth and angles are not measured.

    Args:
        frames: frames of one episode, uint8 ``[T, height, width, 3]``.
        threshold: smallest difference of a colour channel, 0 to 255, of a pixel that moves.

    Returns:
        ``[T, 2]``, x (right) and y (down) in pixels, float64.

    Raises:
        ValueError: nothing moves. The message is the end of a sentence.
    """
    background = _background(frames, threshold)
    centroids = np.full((len(frames), 2), np.nan)
    for t, frame in enumerate(frames):
        difference = _changed(frame, background, threshold)
        mask = cv2.morphologyEx((difference > 0).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        moments = cv2.moments(difference * mask)
        if moments["m00"]:
            centroids[t] = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    seen = ~np.isnan(centroids[:, 0])
    if not seen.any():
        raise ValueError(
            f"nothing moves: no pixel differs by more than {threshold} of 255; use a lower --threshold"
        )
    last = np.maximum.accumulate(np.where(seen, np.arange(len(frames)), np.argmax(seen)))
    return centroids[last]


def _background(frames: np.ndarray, threshold: int) -> np.ndarray:
    change = [_changed(a, b, threshold).mean() for a, b in pairwise(frames)]
    travelled = np.cumsum([0.0, *change])
    samples = np.searchsorted(travelled, np.linspace(0, travelled[-1], SAMPLES))
    return np.median(frames[samples.clip(max=len(frames) - 1)], axis=0).astype(np.uint8)


def _changed(frame: np.ndarray, other: np.ndarray, threshold: int) -> np.ndarray:
    """Return the largest difference of two frames over the channels, and 0 where it is below the threshold."""
    return cv2.threshold(cv2.absdiff(frame, other).max(2), threshold, 0, cv2.THRESH_TOZERO)[1]
