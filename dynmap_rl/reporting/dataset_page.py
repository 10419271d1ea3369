"""``report.html`` of a LeRobot dataset with dynamics columns, recorded or derived."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from dynmap_rl.data.format.frames import choose_camera, iterate_frames, list_cameras
from dynmap_rl.data.format.reading import (
    find_dataset,
    read_column,
    read_info,
    read_metadata,
    read_table,
    spans,
)
from dynmap_rl.data.state import entry_names
from dynmap_rl.keys import DYNAMICS

from .html import write_html

EPISODES = 4  # shown
FRAMES = 120  # of the animation, at most
WIDEST = 192  # pixels of a frame on the page


def write_dataset_page(
    folder: Path, dataset: str | Path, settings: dict, command: str, said: str = ""
) -> None:
    """Write the page: sizes, ranges of the dynamics, an animation of the first episodes, dynamics of the first.

    The dataset is complete without its page: if the page cannot be made, the reason is printed and no error is raised.

    Args:
        folder: folder of ``report.html`` and its pictures.
        dataset: a folder or a hub id.
        settings: settings of the recipe that made the dataset.
        command: command that made the dataset.
        said: further text for the page.
    """
    try:
        print(f"written: {_write_page(folder, find_dataset(dataset), settings, command, said)}")
    except (OSError, ValueError) as error:
        print(f"no page in {folder}: {error}")


def _write_page(folder: Path, root: Path, settings: dict, command: str, said: str) -> Path:
    info = read_info(root)
    quantities = [q for q in DYNAMICS if f"dynamics.{q}" in info["features"]]
    splits = ", ".join(f"{name} {span}" for name, span in (info.get("splits") or {}).items())
    lines = [
        f"{info.get('total_episodes', '?')} episodes ({splits}), {info['total_frames']} frames, "
        f"{info.get('fps', '?')} a second"
    ]
    lines += [*said.splitlines(), "", *_ranges(root, info, quantities)]
    _plot_dynamics(root, info, quantities, folder / "dynamics.png")
    if list_cameras(info):
        _film(root, info, choose_camera(root, info, settings.get("camera")), folder / "episodes.gif")
    return write_html(folder, f"Dataset {root.name}", "\n".join(lines), command, settings)


def _ranges(root: Path, info: dict, quantities: list[str]) -> list[str]:
    """Return a line for each entry of the dynamics: smallest, mean and largest value."""
    stats = read_metadata(root / "meta" / "stats.json")
    lines = [f"{'':40} {'min':>10} {'mean':>10} {'max':>10}"]
    for column in (f"dynamics.{quantity}" for quantity in quantities):
        values = (np.ravel(stats[column][name]) for name in ("min", "mean", "max"))
        for entry, *numbers in zip(entry_names(info, column), *values, strict=True):
            lines.append(f"{f'{column} {entry}':40} " + " ".join(f"{number:10.4g}" for number in numbers))
    return lines


def _plot_dynamics(root: Path, info: dict, quantities: list[str], path: Path) -> None:
    from .figures import plt, save_figure

    columns = [f"dynamics.{quantity}" for quantity in quantities]
    table = read_table(root, info, ["timestamp", *columns])
    _, first = spans(table["episode_index"].to_numpy())[0]
    time = read_column(root, info, table, "timestamp")[first, 0]
    figure, axes = plt.subplots(
        len(columns), 1, figsize=(9, 2.2 * len(columns)), sharex=True, squeeze=False, layout="constrained"
    )
    for axis, column in zip(axes.flat, columns, strict=True):
        values = read_column(root, info, table, column)[first]
        for i, entry in enumerate(entry_names(info, column)):
            axis.plot(time, values[:, i], lw=1.2, label=entry)
        axis.set_title(column, fontsize=9)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, ncols=6)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    save_figure(figure, path)


def _film(root: Path, info: dict, camera: str, path: Path) -> None:
    """Write the first episodes; long ones are thinned out, and short ones stand still at their end."""
    from .media import save_gif

    episodes = []
    for _, frames, _ in iterate_frames(root, info, camera, widest=WIDEST):
        episodes.append(frames)
        if len(episodes) == EPISODES:
            break
    steps = max(map(len, episodes))
    every = -(-steps // FRAMES)
    shown = np.arange(0, steps, every)
    frames = np.stack([frames[np.minimum(shown, len(frames) - 1)] for frames in episodes])
    pixels = torch.from_numpy(frames).permute(0, 1, 4, 2, 3)
    scale = max(1, WIDEST // pixels.shape[-1])
    save_gif(pixels, path, every / info.get("fps", 20), columns=len(episodes), scale=scale)
