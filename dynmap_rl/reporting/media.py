"""Animations of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from tensordict.nn import TensorDictModuleBase

from dynmap_rl.data.recording.demonstrators import demonstrate
from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.envs.renderer import Renderer
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.evaluation.protocol import unpack_rows
from dynmap_rl.evaluation.rollout import failures_first, roll_out
from dynmap_rl.experts.network import ExpertNetwork, play


def save_gif(pixels: torch.Tensor, path: Path, dt: float, columns: int = 4, scale: int = 3) -> None:
    """Write episodes side by side as one animation, with some 25 frames a second at most.

    Args:
        pixels: frames uint8 ``[E, T, 3, H, W]``.
        path: file to write.
        dt: time between two frames (s).
        columns: episodes in a row.
        scale: pixels of the animation for a pixel of a frame.
    """
    every = max(1, round(0.04 / dt))  # players slow down films with more frames
    pixels = pixels[:, (pixels.shape[1] - 1) % every :: every]  # with the last one
    episodes, steps, _, height, width = pixels.shape
    rows = -(-episodes // columns)
    frames = pixels.permute(1, 0, 3, 4, 2).numpy()  # (T, E, H, W, 3)
    blank = np.full((steps, rows * columns - episodes, height, width, 3), 255, np.uint8)
    grid = np.concatenate([frames, blank], 1).reshape(steps, rows, columns, height, width, 3)
    grid = grid.swapaxes(2, 3).reshape(steps, rows * height, columns * width, 3)
    size = columns * width * scale, rows * height * scale
    images = [Image.fromarray(f).convert("P", palette=Image.Palette.ADAPTIVE) for f in grid]  # small: quick
    images = [image.resize(size, Image.Resampling.NEAREST) for image in images]
    durations = frame_durations(len(images), every * dt)
    path.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)


def frame_durations(count: int, dt: float) -> list[float]:
    """Return the durations (ms) of frames that are ``dt`` seconds apart, in a file that counts in steps of 10 ms."""
    ends = (100 * dt * np.arange(count + 1)).round()
    return (10 * np.diff(ends)).tolist()


def film(
    network: ExpertNetwork, task: Task, scene_seeds: Sequence[int], path: Path, states: Task | None = None
) -> None:
    """Write episodes of an expert as an animation.

    Args:
        network: the expert.
        task: the task to film.
        scene_seeds: seeds of the scenes, an episode each.
        path: file to write.
        states: task whose states the expert reads; by default ``task``.
    """
    renderer = Renderer()
    steps = play(network, task, scene_seeds, states)
    frames = np.stack([[renderer.draw(world, task) for world in worlds] for worlds in steps], 1)
    save_gif(torch.from_numpy(frames).permute(0, 1, 4, 2, 3), path, task.layout.dt)


def film_demonstrator(task: str, scene_seeds: Sequence[int], path: Path) -> None:
    """Write episodes of a task's demonstrator as an animation.

    Args:
        task: name of the task.
        scene_seeds: seeds of the scenes, an episode each.
        path: file to write.
    """
    save_gif(demonstrate(task, scene_seeds)["pixels"], path, get_task(task).layout.dt)


def film_policy(
    actor: TensorDictModuleBase,
    task: str,
    rows: dict,
    path: Path,
    delay: FrameDelay | None = None,
    failures: bool = False,
) -> None:
    """Write eight evaluated episodes as an animation, failures first.

    They are rolled out again. A policy that samples its actions, such as Diffusion Policy, may act otherwise this time.

    Args:
        actor: the actor that was evaluated.
        task: name of the task.
        rows: ``rows`` of the result of :func:`dynmap_rl.evaluation.evaluate`.
        path: file to write.
        delay: delay of the frames in that evaluation.
        failures: failures alone, where there are any.
    """
    some = [row["scene_seed"] for row in choose_episodes(rows, failures)]
    save_gif(roll_out(actor, task, some, True, delay)["pixels"], path, get_task(task).layout.dt)


def choose_episodes(rows: dict, failures: bool = False) -> list[dict]:
    """Return the rows of the episodes that :func:`film_policy` shows, in their order."""
    rows = {row["scene_seed"]: row for row in unpack_rows(rows)}
    return [
        rows[s] for s in failures_first(list(rows), [r["success"] for r in rows.values()], alone=failures)
    ]
