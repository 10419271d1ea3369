"""What a frozen world model makes of episodes, computed once: the input of decoupled policy training (Sec. III-B)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from dynmap_rl.modules import WorldModel

from .augmentation import augment


@torch.no_grad()
def compute_features(
    world_model: WorldModel,
    episodes: TensorDictBase,
    copies: int = 0,
    generator: torch.Generator | None = None,
    max_shift: int = 0,
    batch: int = 10,
) -> TensorDict:
    """Latents and hidden states of whole episodes, with the actions and goals that go with them.

    Args:
        world_model: frozen.
        episodes: ``[E, T]`` with ``pixels``, ``action``, ``goal``, ``dynamics``.
        copies: so many augmented versions of every episode follow the plain ones.
        generator: of the augmentations.
        max_shift: pixels by which the copies are shifted; 0 where a place in the picture means something, such as
            that of an obstacle which is always there.

    Returns:
        ``[(1 + copies) E, T]`` with ``latent``, ``hidden1``, ``hidden2``, ``action``, ``goal`` and, where the episodes
        have it, ``disturbed``.
    """
    parts = []
    for copy in range(copies + 1):
        for chunk in tqdm(episodes.split(batch), f"states {copy + 1}/{copies + 1}", leave=False):
            if copy:
                chunk = augment(chunk, generator, max_shift, mirror=False)  # an expert may prefer one side
            latent = world_model.encode(chunk["pixels"])
            _, hidden1, hidden2 = world_model.predict(latent, chunk["action"])
            features = {"latent": latent, "hidden1": hidden1, "hidden2": hidden2}
            kept = chunk.select("action", "goal", "disturbed", strict=False)
            parts.append(TensorDict(features, chunk.shape).update(kept))
    return torch.cat(parts)
