"""Latents and hidden states of a frozen world model: the input of decoupled policy training (paper, Sec. III-B)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.imitation import find_target


@torch.no_grad()
def compute_features(
    world_model: WorldModel,
    episodes: TensorDictBase,
    batch: int = 10,
    change: Callable[[TensorDictBase], TensorDictBase] | None = None,
) -> TensorDict:
    """Compute latents and hidden states of whole episodes.

    Args:
        world_model: frozen world model; the result is on its device.
        episodes: ``[E, T]`` with ``pixels``, ``action``, ``goal``, ``dynamics`` and, optional, ``expert_action`` and
            ``disturbed``.
        batch: number of episodes computed at a time.
        change: function of the episodes of a batch that is applied first, such as :func:`dynmap_rl.data.augment`.

    Returns:
        ``[E, T]`` with ``latent``, ``hidden1``, ``hidden2``, ``goal``, the ``action`` to imitate, and ``disturbed`` bool
        ``[..., 1]``: steps that imitation leaves out (see :func:`dynmap_rl.objectives.imitation.find_target`), and
        ``step_count`` ``[..., 1]``, by default from 0.
    """
    device = next(world_model.parameters()).device
    target, ignore = find_target(episodes)
    ignore = torch.zeros(*episodes.shape, 1, dtype=torch.bool) if ignore is None else ignore
    episodes = episodes.copy().set("expert_action", target).set("disturbed", ignore)
    if "step_count" not in episodes.keys():
        steps = torch.arange(episodes.shape[1], device=episodes.device)
        episodes["step_count"] = steps[:, None].expand(*episodes.shape, 1)
    parts = []
    for chunk in tqdm(episodes.split(batch), "states", leave=False):
        chunk = (change(chunk) if change else chunk).to(device)
        latent = world_model.encode(chunk["pixels"], mixed=True)
        _, hidden1, hidden2 = world_model.predict(latent, chunk["action"])
        features = {"latent": latent, "hidden1": hidden1, "hidden2": hidden2}
        chunk = chunk.select("expert_action", "goal", "disturbed", "step_count")
        chunk = chunk.rename_key_("expert_action", "action")
        parts.append(TensorDict(features, chunk.shape).update(chunk))
    return torch.cat(parts)
