"""What a frozen world model makes of episodes, computed once: the input of decoupled policy training (Sec. III-B)."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tqdm import tqdm

from .augmentation import augment
from dynmap_rl.modules.world_model import WorldModel


@torch.no_grad()
def compute_features(
    world_model: WorldModel,
    episodes: TensorDictBase,
    copies: int = 0,
    generator: torch.Generator | None = None,
    batch: int = 10,
    recolor: bool = True,
) -> TensorDict:
    """Latents and hidden states of whole episodes, with the actions and goals that go with them.

    Args:
        world_model: frozen; the result is on its device.
        episodes: ``[E, T]`` with ``pixels``, ``action``, ``goal``, ``dynamics``.
        copies: so many recoloured versions of every episode follow the plain ones, each from a random step on.
        generator: of the copies.
        recolor: false where colours have a meaning, and labels are not those of our tasks.

    Returns:
        ``[(1 + copies) E, T]`` with ``latent``, ``hidden1``, ``hidden2``, ``action``, ``goal`` and ``disturbed``: the
        steps that are no demonstration, by a push or beyond the end.
    """
    device = next(world_model.parameters()).device
    if "disturbed" not in episodes:
        episodes = episodes.copy().set("disturbed", torch.zeros(*episodes.shape, 1, dtype=torch.bool))
    parts = []
    for copy in range(copies + 1):
        for chunk in tqdm(episodes.split(batch), f"states {copy + 1}/{copies + 1}", leave=False):
            chunk = chunk.to(device)
            if copy:
                chunk = _start_anywhere(chunk, generator)
                if recolor:
                    # Neither shifted nor mirrored: an obstacle has its place, and an expert may prefer one side.
                    chunk = augment(chunk, generator, max_shift=0, mirror=False)
            latent = world_model.encode(chunk["pixels"], mixed=True)
            _, hidden1, hidden2 = world_model.predict(latent, chunk["action"])
            features = {"latent": latent, "hidden1": hidden1, "hidden2": hidden2}
            parts.append(
                TensorDict(features, chunk.shape).update(chunk.select("action", "goal", "disturbed"))
            )
    return torch.cat(parts)


def _start_anywhere(episodes: TensorDictBase, generator: torch.Generator) -> TensorDictBase:
    """Let each episode ``[E, T]`` begin at a random step of its first half, where memory is empty. What is then missing
    at the end repeats the last step, and is marked as ``disturbed``, which imitation leaves out.

    Memory tells the last action, and the next is nearly the same: a policy that only copies it has a low loss, but
    stands still when control begins. So it must often decide by what it sees.
    """
    count, steps = episodes.shape
    device = generator.device
    start = torch.randint(steps // 2, (count, 1), generator=generator, device=device)
    index = start + torch.arange(steps, device=device)
    episodes = episodes[torch.arange(count, device=device)[:, None], index.clamp(max=steps - 1)]
    over = (index >= steps).unsqueeze(-1)
    return episodes.set("disturbed", episodes["disturbed"] | over)
