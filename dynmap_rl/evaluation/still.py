"""Reuse of latents while nothing moves in the picture, which is most of an episode after the goal is reached."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import nn

from dynmap_rl.modules.world_model import WorldModel


class StillEncoder(nn.Module):
    """Encoder that computes only the frames that differ from the frames of the last call.

    Args:
        encoder: encoder of frames ``[N, 3, H, W]``; frames with other leading axes are always encoded.
    """

    def __init__(self, encoder: nn.Module):
        super().__init__()
        self.encoder, self.frames = encoder, None

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Encode frames as latents ``[N, Z]``."""
        if pixels.dim() != 4 or self.frames is None or self.frames.shape != pixels.shape:
            latent = self.encoder(pixels)
        else:
            latent, moved = self.latent, (pixels != self.frames).flatten(1).any(1)
            if moved.any():
                latent = latent.clone()
                latent[moved] = self.encoder(pixels[moved])
        self.frames, self.latent = pixels, latent
        return latent


@contextlib.contextmanager
def reuse_still_frames(actor: nn.Module) -> Iterator[None]:
    """Let the world models of an actor encode only frames that change, until the end of the block."""
    models = [module for module in actor.modules() if isinstance(module, WorldModel)]
    encoders = [model.encoder for model in models]
    try:
        for model in models:
            model.encoder = StillEncoder(model.encoder)
        yield
    finally:
        for model, encoder in zip(models, encoders, strict=True):
            model.encoder = encoder
