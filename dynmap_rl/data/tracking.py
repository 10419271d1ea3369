"""Where what moves is in the picture: positions for datasets that have no state."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

SAMPLES = (
    51  # frames of an episode that its background is the median of; odd, so that it is one of their values
)
WIDEST = 160  # pixels that frames are reduced to: the centroid is finer than a pixel anyhow


def track_centroid(frames: np.ndarray, threshold: int = 30) -> np.ndarray:
    """The centroid of what differs from the episode's background: ``[T, 2]`` x (right) and y (down), pixels, float64.

    The background is the median of frames that are equally far apart not in time but in how much the picture changed,
    so that something which rests for most of an episode does not become background. Pixels weigh by their difference;
    specks of less than 3 x 3 pixels are left out; where nothing differs, the last centroid stands, before the first one
    that one.

    It is one point for all that moves: arm, object and shadows together. The camera must stand still and the light must
    not change. What never moves is not seen, and where something stays in one place for most of the change, that place
    counts as moved when it is empty. It says nothing of depth and nothing of angles.

    Args:
        frames: of one episode, uint8 ``[T, height, width, 3]``.
        threshold: difference in any colour channel, of 255, from which on a pixel has changed.

    Raises:
        ValueError: nothing moves.
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
            f"nothing moves: no pixel differs by more than {threshold} of 255; try a lower --threshold"
        )
    last = np.maximum.accumulate(np.where(seen, np.arange(len(frames)), np.argmax(seen)))
    return centroids[last]


def _background(frames: np.ndarray, threshold: int) -> np.ndarray:
    change = [_changed(a, b, threshold).mean() for a, b in pairwise(frames)]
    travelled = np.cumsum([0.0, *change])
    samples = np.searchsorted(travelled, np.linspace(0, travelled[-1], SAMPLES))
    return np.median(frames[samples.clip(max=len(frames) - 1)], axis=0).astype(np.uint8)


def _changed(frame: np.ndarray, other: np.ndarray, threshold: int) -> np.ndarray:
    """The difference of two frames in the channel where it is largest, 0 where it is below the threshold."""
    return cv2.threshold(cv2.absdiff(frame, other).max(2), threshold, 0, cv2.THRESH_TOZERO)[1]
