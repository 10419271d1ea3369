"""Velocities of tracked objects by dense optical flow."""

from __future__ import annotations

import cv2
import numpy as np

from .tracking import Tracks, fill_gaps

FARNEBACK = {  # names of OpenCV; no pyramid reduction below 32 pixels is of use
    "pyr_scale": 0.5,
    "levels": 3,
    "winsize": 9,
    "iterations": 5,
    "poly_n": 5,
    "poly_sigma": 1.1,
    "flags": 0,
}


def flow_velocity(frames: np.ndarray, tracks: Tracks, time: np.ndarray) -> np.ndarray:
    """Compute the velocity of every object from the flow between neighbouring frames.

    The flow is Farneback's (``cv2.calcOpticalFlowFarneback``). A rigid motion is fitted to the flow of an object's
    pixels, weighted by the gradient of the picture, since the flow of a plain surface is not observed. The velocity of
    a frame is the mean of those before and after it.

    Args:
        frames: frames of one episode, uint8 ``[T, height, width, 3]``.
        tracks: objects in these frames.
        time: times of the frames ``[T]`` (s).

    Returns:
        ``[T, N, 3]``, the change of x, y (pixels) and angle (rad) per s. Where an object is not found, it is
        interpolated.
    """
    count = tracks.pose.shape[1]
    gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    steps = np.zeros((len(frames) - 1, count, 3))
    for t, step in enumerate(steps):
        flow = cv2.calcOpticalFlowFarneback(gray[t], gray[t + 1], None, **FARNEBACK)
        gradient = np.hypot(cv2.Sobel(gray[t], cv2.CV_32F, 1, 0), cv2.Sobel(gray[t], cv2.CV_32F, 0, 1))
        for n in range(count):
            step[n] = _rigid(flow, gradient, tracks.labels[t] == n + 1, tracks.pose[t, n])
    steps /= np.diff(time)[:, None, None]
    both = tracks.found[:-1] & tracks.found[1:]
    for n in range(count):
        if both[:, n].any():
            steps[:, n] = fill_gaps(steps[:, n], both[:, n])
    return np.concatenate([steps[:1], (steps[1:] + steps[:-1]) / 2, steps[-1:]])


def _rigid(flow: np.ndarray, gradient: np.ndarray, mask: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Fit a translation and a rotation to the flow within a mask by weighted least squares."""
    y, x = np.nonzero(mask)
    weight = np.sqrt(gradient[y, x] + 1e-3)
    if len(x) < 3:
        return np.zeros(3)
    one, zero = np.ones(len(x)), np.zeros(len(x))
    rows = np.concatenate([np.stack([one, zero, pose[1] - y], 1), np.stack([zero, one, x - pose[0]], 1)])
    weights = np.concatenate([weight, weight])
    target = flow[y, x].T.ravel()
    return np.linalg.lstsq(rows * weights[:, None], target * weights, rcond=None)[0]
