"""Latents and hidden states of a frozen world model: the input of decoupled policy training (paper, Sec. III-B)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import find_target

from .augmentation import augment


@torch.no_grad()
def compute_features(
    world_model: WorldModel,
    episodes: TensorDictBase,
    copies: int = 0,
    generator: torch.Generator | None = None,
    batch: int = 10,
    recolor: bool = True,
) -> TensorDict:
    """Compute latents and hidden states of whole episodes.

    Args:
        world_model: frozen world model; the result is on its device.
        episodes: ``[E, T]`` with ``pixels``, ``action``, ``goal``, ``dynamics`` and, optional, ``expert_action`` and ``disturbed``.
        copies: number of further versions of every episode, each from a random step on.
        generator: source of the random numbers of the copies, on the device of the world model.
        batch: number of episodes computed at a time.
        recolor: permute the colour channels of the copies.

    Returns:
        ``[(1 + copies) E, T]`` with ``latent``, ``hidden1``, ``hidden2``, ``goal``, the ``action`` to imitate, and
        ``disturbed`` bool ``[..., 1]``: steps that imitation leaves out (see
        :func:`dynmap_rl.objectives.imitation.find_target`), also where the episode was over.
    """
    device = next(world_model.parameters()).device
    target, ignore = find_target(episodes)
    ignore = torch.zeros(*episodes.shape, 1, dtype=torch.bool) if ignore is None else ignore
    episodes = episodes.copy().set("expert_action", target).set("disturbed", ignore)
    parts = []
    for copy in range(copies + 1):
        for chunk in tqdm(episodes.split(batch), f"states {copy + 1}/{copies + 1}", leave=False):
            chunk = chunk.to(device)
            if copy:
                chunk = _start_anywhere(chunk, generator)
                if recolor:
                    # No shift and no mirror: an obstacle has its place, and an expert may prefer one side.
                    chunk = augment(chunk, generator, max_shift=0, mirror=False)
            latent = world_model.encode(chunk["pixels"], mixed=True)
            _, hidden1, hidden2 = world_model.predict(latent, chunk["action"])
            features = {"latent": latent, "hidden1": hidden1, "hidden2": hidden2}
            chunk = chunk.select("expert_action", "goal", "disturbed").rename_key_("expert_action", "action")
            parts.append(TensorDict(features, chunk.shape).update(chunk))
    return torch.cat(parts)


def _start_anywhere(episodes: TensorDictBase, generator: torch.Generator) -> TensorDictBase:
    """Let each episode ``[E, T]`` begin at a random step of its first half, with empty memory.

    The missing steps at the end repeat the last step and are marked as ``disturbed``.

    Memory holds the last action, and the next action is nearly the same. A policy that copies the last action has a low
    loss but stands still when control begins. Empty memory makes the policy decide by the frame.
    """
    count, steps = episodes.shape
    device = generator.device
    start = torch.randint(steps // 2, (count, 1), generator=generator, device=device)
    index = start + torch.arange(steps, device=device)
    episodes = episodes[torch.arange(count, device=device)[:, None], index.clamp(max=steps - 1)]
    over = (index >= steps).unsqueeze(-1)
    return episodes.set("disturbed", episodes["disturbed"] | over)
