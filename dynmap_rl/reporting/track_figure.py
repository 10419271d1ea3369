"""Figure of tracked objects over the frames of an episode."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dynmap_rl.data.camera import FrameSource, track
from dynmap_rl.data.format.frames import iterate_frames
from dynmap_rl.data.format.reading import find_dataset, read_info
from dynmap_rl.data.tracking import WIDEST

from .figures import plt, save_figure

SHOWN = 8  # frames


def plot_tracks(dataset: str | Path, view: FrameSource, episode: int, path: Path) -> None:
    """Draw outline, centre and axis of every object on frames of one episode, at equal distances in time.

    A cross in the place of the centre says that the object was not found in the frame.

    Args:
        dataset: folder or hub id.
        view: how objects are tracked.
        episode: index of the episode.
        path: file to write.
    """
    root = find_dataset(dataset)
    _, frames, _ = next(iterate_frames(root, read_info(root), view.column, widest=WIDEST, only=[episode]))
    tracks = track(frames, view)
    shown = np.linspace(0, len(frames) - 1, SHOWN).round().astype(int)
    figure, axes = plt.subplots(2, SHOWN // 2, figsize=(9, 5), layout="constrained")
    for axis, t in zip(axes.flat, shown, strict=True):
        axis.imshow(frames[t])
        for n in range(view.objects):
            color = plt.get_cmap("tab10")(n)
            if (mask := tracks.labels[t] == n + 1).any():
                axis.contour(mask, [0.5], colors=[color], linewidths=0.8)
            x, y, angle = tracks.pose[t, n]
            length = np.sqrt(max(tracks.area[t, n], 16)) / 2
            axis.plot(x, y, "." if tracks.found[t, n] else "x", color=color, ms=5)
            ends = np.array([-length, length])
            if not view.point:
                axis.plot(x + ends * np.cos(angle), y + ends * np.sin(angle), color=color, lw=1)
        axis.set_title(f"episode {episode}, frame {t}", fontsize=7)
        axis.set(xticks=[], yticks=[])
    save_figure(figure, path)
