"""Segmentation of frames by colour: what moves, and which object a pixel belongs to."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

BINS = 16  # levels of a colour channel in histograms
SPARE = 3  # colours besides those of the objects: shadows, edges, and places that were taken for background
FAINTEST = 0.3  # share of the usual area from which on an object counts as found
RAREST = 0.1  # share of the frames in which a colour must be seen to be that of an object


def find_moving(frames: np.ndarray, changed: np.ndarray, ever: np.ndarray) -> np.ndarray:
    """Return masks ``[T, height, width]`` of what moves, by colour."""
    colors = np.empty(frames.shape[:3], np.uint16)
    moving, still = np.zeros((2, BINS**3), int)
    for color, frame, where in zip(colors, frames, changed, strict=True):  # all at once would be large
        color[:] = (frame // (256 // BINS)).astype(np.uint16) @ np.array([BINS**2, BINS, 1], np.uint16)
        moving += np.bincount(color[where], minlength=BINS**3)
        still += np.bincount(color[~ever], minlength=BINS**3)
    likely = moving / moving.sum() > still / still.sum()
    masks = np.stack([likely[color] for color in colors])
    for mask in masks:  # what never changes may have the same colour
        mask &= _touched(mask, ever)
    return masks


def _touched(mask: np.ndarray, ever: np.ndarray) -> np.ndarray:
    """Return the regions of a mask ``[height, width]`` that contain pixels which ever change."""
    count, regions = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    return (np.bincount(regions[ever & mask], minlength=count) > 0)[regions]


def find_colors(
    frames: np.ndarray, ever: np.ndarray, colors: Sequence[tuple[int, int, int]], threshold: int
) -> np.ndarray:
    """Return the number of the object of every pixel by given colours, uint8 ``[T, height, width]``; 0 is none."""
    seen, moving = np.zeros((2, *frames.shape[:3]), np.uint8)
    for t, frame in enumerate(frames):
        distance = np.stack([cv2.absdiff(frame, np.full_like(frame, color)).max(2) for color in colors])
        nearest = distance.argmin(0)
        for n in range(len(colors)):
            mask = (nearest == n) & (distance[n] < threshold)
            seen[t][mask] = n + 1
            moving[t][mask & _touched(mask, ever)] = n + 1
    for n in range(1, len(colors) + 1):
        if not (moving == n).any():  # the object rests in the whole episode
            moving[seen == n] = n
    return moving


def split_colors(frames: np.ndarray, masks: np.ndarray, objects: int, threshold: int) -> np.ndarray:
    """Return the number of the object of every pixel, uint8 ``[T, height, width]``; 0 is none."""
    from scipy.cluster.vq import vq

    if objects == 1:
        return masks.astype(np.uint8)
    few = f"fewer than {objects} objects of different colours move; use fewer --objects"
    pixels = frames[masks].astype(np.float32)
    sample = pixels[:: max(1, len(pixels) // 20_000)]
    if (count := len(np.unique(sample, axis=0))) < objects:
        raise ValueError(few)
    cv2.setRNGSeed(0)
    criteria = cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.5
    count = min(objects + SPARE, count)
    _, _, centers = cv2.kmeans(sample, count, None, criteria, 3, cv2.KMEANS_PP_CENTERS)
    merged = _merge(centers, threshold)
    nearest = np.full(masks.shape, len(centers), np.uint8)
    nearest[masks] = merged[vq(pixels, centers, check_finite=False)[0]]
    motion = [_motion(nearest == k) for k in range(len(centers))]
    chosen = np.argsort(motion)[::-1][:objects]
    if not np.take(motion, chosen).all():
        raise ValueError(few)
    numbers = np.zeros(len(centers) + 1, np.uint8)
    numbers[chosen] = np.arange(1, objects + 1)
    return numbers[nearest]


def _merge(centers: np.ndarray, threshold: int) -> np.ndarray:
    """Return for each colour the number of its group: colours that differ by less than the threshold, in chains."""
    from scipy.sparse.csgraph import connected_components

    close = np.abs(centers[:, None] - centers).max(-1) < threshold
    return connected_components(close)[1].astype(np.uint8)


def _motion(masks: np.ndarray) -> float:
    """Return how much a colour moves: the spread of its centre times the root of its area, 0 for a rare colour."""
    area = masks.sum((1, 2))
    seen = area >= faintest(area)
    if seen.mean() < RAREST:
        return 0.0
    centers = np.array([np.argwhere(mask).mean(0) for mask in masks[seen]])
    spread = np.linalg.norm(np.quantile(centers, 0.95, axis=0) - np.quantile(centers, 0.05, axis=0))
    return float(spread * np.sqrt(np.median(area[seen])))


def faintest(area: np.ndarray) -> float:
    """Return the area from which on an object counts as found, given its area in all frames."""
    return max(4.0, FAINTEST * float(np.median(area[area > 0]))) if area.any() else np.inf
