"""What a world model sees: colours of cart, block and goal in predicted frames, and the cart's place in the latent."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import batched

import numpy as np
import torch
from tensordict import TensorDictBase

from dynmap_rl.data.features import compute_features
from dynmap_rl.data.recording.plans import Plan, run_plans
from dynmap_rl.envs.scene import GOAL_COLOR, Scene, scene_seeds
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.modules.world_model import WorldModel


@torch.no_grad()
def color_errors(
    world_model: WorldModel, episodes: TensorDictBase, scenes: Sequence[Scene], batch: int = 10
) -> dict[str, float]:
    """Measure the colours of one-step predictions on the pixels of the objects.

    Args:
        world_model: what predicts.
        episodes: ``[E, T]`` with ``pixels``, drawn without antialiasing, and ``action``.
        scenes: the scene of each episode, which knows the colours.
        batch: episodes at a time.

    Returns:
        ``object_error``, the root mean square error of the colours of cart and block (0 to 1); ``chroma_explained``, the
        share (R^2) of the variation of their chroma, that is of the channels less their mean; ``goal_explained``, the
        share of the difference from the background of everything in the goal's colour: of the visible marker, and of the
        walls of tasks 2 and 3; and ``background_error``, the root mean square error on all other pixels. Of the shares, 1
        is perfect; 0 is as good as one chroma for all objects, and as nothing in the goal's colour.
    """
    device = next(world_model.parameters()).device
    names = "object", "object_truth", "goal", "goal_truth", "blank"
    found: dict[str, list[torch.Tensor]] = {name: [] for name in names}
    rest, pixels = 0.0, 0
    for chunk, some in zip(episodes.split(batch), batched(scenes, batch), strict=True):
        chunk = chunk.to(device)
        latent = world_model.encode(chunk["pixels"], mixed=True)
        states = world_model.predict(latent, chunk["action"])
        predicted = world_model.decode_pixels(*(s[:, 1:] for s in states)).movedim(2, -1).cpu()
        frames = chunk["pixels"][:, 1:].movedim(2, -1).cpu()
        colors = torch.tensor(
            [[s.cart_color, s.block_color, s.background_color] for s in some], dtype=torch.uint8
        )
        cart, block, background = colors[:, :, None, None, None].unbind(1)  # (B, 1, 1, 1, 3)
        objects = (frames == cart).all(-1) | (frames == block).all(-1)
        goal = (frames == torch.tensor(GOAL_COLOR, dtype=torch.uint8)).all(-1)
        for name, mask in (("object", objects), ("goal", goal)):
            found[name].append(predicted[mask])
            found[f"{name}_truth"].append(frames[mask] / 255)
        found["blank"].append(background.expand_as(frames)[goal] / 255)
        others = (predicted - frames / 255)[~(objects | goal)]
        rest, pixels = rest + others.double().square().sum().item(), pixels + others.numel()
    values = {name: torch.cat(parts).double() for name, parts in found.items()}
    seen, truth = values["object"], values["object_truth"]
    chroma, true_chroma = (x - x.mean(-1, keepdim=True) for x in (seen, truth))
    return {
        "object_error": (seen - truth).square().mean().sqrt().item(),
        "chroma_explained": _explained(chroma, true_chroma, true_chroma.mean(0)),
        "goal_explained": _explained(values["goal"], values["goal_truth"], values["blank"]),
        "background_error": (rest / pixels) ** 0.5,
    }


@torch.no_grad()
def locate_cart(world_model: WorldModel, train: TensorDictBase, test: TensorDictBase) -> float:
    """Return the mean distance (m) of the cart's position and a linear map of the latent.

    Args:
        world_model: what encodes.
        train: episodes ``[E, T]`` to fit the map to, with ``pixels``, ``action``, ``goal`` and ``dynamics``.
        test: likewise, to measure the distance on.
    """
    (x, y), (x_test, y_test) = (_latents_and_positions(world_model, part) for part in (train, test))
    weights = torch.linalg.lstsq(x, y, driver="gelsd").solution
    return (x_test @ weights - y_test).norm(dim=-1).mean().item()


def _latents_and_positions(
    world_model: WorldModel, episodes: TensorDictBase
) -> tuple[torch.Tensor, torch.Tensor]:
    latent = compute_features(world_model, episodes)["latent"].flatten(0, 1).double().cpu()
    position = episodes["dynamics", "position"][..., :2].flatten(0, 1).double().cpu()
    return torch.nn.functional.pad(latent, (0, 1), value=1.0), position


def begin_scenes(task: str, count: int, steps: int = 11) -> tuple[TensorDictBase, list[Scene]]:
    """Return the first steps of the expert in validation scenes, with the cart still away from the goal.

    Args:
        task: name of the task.
        count: number of scenes.
        steps: number of frames; the first is the context of the first prediction.

    Returns:
        Episodes ``[count, steps]`` and their scenes.
    """
    checkpoint = list_checkpoints(task)[-1]
    plans = [Plan(seed, checkpoint) for seed in scene_seeds("validation", count)]
    rules = get_task(task)
    scenes = [rules.sample_scene(np.random.default_rng(plan.scene_seed)) for plan in plans]
    return run_plans(task, plans)[:, :steps], scenes


def _explained(values: torch.Tensor, truth: torch.Tensor, guess: torch.Tensor) -> float:
    """Return the share of the squared deviation of ``truth`` from ``guess`` that ``values`` explain."""
    return 1 - ((values - truth).square().sum() / (guess - truth).square().sum().clamp_min(1e-12)).item()
