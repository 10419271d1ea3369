"""The state-based expert: its network and the checkpoints that ship with the package (paper, Sec. IV-C)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tensordict.nn import TensorDictModuleBase

from dynmap_rl.envs.renderer import Renderer
from dynmap_rl.envs.tasks import BalanceReaching
from dynmap_rl.evaluation.protocol import _rows
from dynmap_rl.evaluation.rollout import failures_first, roll_out
from dynmap_rl.experts.network import ExpertNetwork, play


def film(
    network: ExpertNetwork,
    task: BalanceReaching,
    scene_seeds: Sequence[int],
    path: Path,
    states: BalanceReaching | None = None,
) -> None:
    """:func:`play` as an animation."""
    from .media import save_gif

    renderer = Renderer()
    steps = play(network, task, scene_seeds, states)
    frames = np.stack(
        [[renderer.draw(world, task) for world in worlds] for worlds in steps], 1
    )  # [E, T, ...]
    save_gif(torch.from_numpy(frames).permute(0, 1, 4, 2, 3), path)


def save_gif(pixels: torch.Tensor, path: Path, columns: int = 4, scale: int = 3) -> None:
    """Frames ``[E, T, 3, H, W]`` of E episodes as one animation, 20 steps a second."""
    episodes, steps, _, height, width = pixels.shape
    rows = -(-episodes // columns)
    frames = pixels.permute(1, 0, 3, 4, 2).numpy()  # (T, E, H, W, 3)
    blank = np.full((steps, rows * columns - episodes, height, width, 3), 255, np.uint8)
    grid = np.concatenate([frames, blank], 1).reshape(steps, rows, columns, height, width, 3)
    grid = grid.swapaxes(2, 3).reshape(steps, rows * height, columns * width, 3)
    size = columns * width * scale, rows * height * scale
    images = [Image.fromarray(f).resize(size, Image.Resampling.NEAREST) for f in grid]
    path.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(path, save_all=True, append_images=images[1:], duration=50, loop=0, optimize=True)


def film_policy(actor: TensorDictModuleBase, task: str, rows: dict, path: Path) -> None:
    """Some of the episodes whose ``rows`` :func:`evaluate` gave as an animation, failures first."""
    from .media import save_gif

    rows = _rows(rows)
    some = failures_first([row["scene_seed"] for row in rows], [row["success"] for row in rows])
    save_gif(roll_out(actor, task, some, keep_pixels=True)["pixels"], path)
