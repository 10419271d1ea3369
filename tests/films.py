"""Synthetic films of known motion: a lying and a standing bar, of two colours, on a flat background."""

import cv2
import numpy as np

BACKGROUND, COLORS = (220, 220, 210), ((150, 40, 40), (40, 40, 150))
SIZES = (24, 6), (8, 20)  # length along x, and along y, in pixels


def make_poses(steps=60, extent=0.5, seed=0):
    """Poses ``[T, 2, 3]`` (x and y as shares of the picture, angle clockwise) that speed up, slow down and rest."""
    rng = np.random.default_rng(seed)
    way = np.clip(np.linspace(-0.1, 1.4, steps), 0, 1)
    way = (1 - np.cos(np.pi * way)) / 2
    start = np.array([0.5 - extent / 2, 0.65])
    end = start + extent * np.array([1.0, -0.4])
    lower = start + way[:, None] * (end - start)
    turn = rng.uniform(0.2, 0.4) * np.sin(np.pi * way)
    upper = lower - [0.0, 0.22]
    return np.stack([np.c_[lower, turn], np.c_[upper, -turn]], 1)


def film(poses, size=96, bodies=(0, 1), colors=COLORS, scale=1.0, noise=0.0, background=None, seed=0):
    """Draw frames uint8 ``[T, size, size, 3]``, without antialiasing."""
    rng = np.random.default_rng(seed)
    frames = []
    for t, pose in enumerate(poses):
        frame = np.empty((size, size, 3), np.uint8)
        frame[:] = BACKGROUND if background is None else background(t)
        for n in bodies:
            x, y, angle = pose[n]
            rect = (x * size - 0.5, y * size - 0.5), tuple(scale * s for s in SIZES[n]), np.degrees(angle)
            cv2.fillPoly(frame, [np.round(cv2.boxPoints(rect)).astype(np.int32)], colors[n])
        frames.append(np.clip(frame + noise * rng.standard_normal(frame.shape), 0, 255).astype(np.uint8))
    return np.stack(frames)
