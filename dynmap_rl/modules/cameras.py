"""Frames of several cameras, side by side: an encoder and a decoder for each."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn


class CameraEncoders(nn.Module):
    """Sum of the latents of one encoder for each camera, which is one linear map of the features of all.

    Args:
        encoders: encoders of frames ``[..., 3, S, S]``, one for each camera.
        image_size: S.
    """

    def __init__(self, encoders: Sequence[nn.Module], image_size: int):
        super().__init__()
        self.encoders, self.image_size = nn.ModuleList(encoders), image_size

    def forward(self, pixels: torch.Tensor) -> torch.Tensor:
        """Encode frames ``[..., 3, S, cameras * S]`` in 0..255 as latents ``[..., Z]``.

        Raises:
            ValueError: the frames have another shape.
        """
        shape = 3, self.image_size, self.image_size * len(self.encoders)
        if pixels.shape[-3:] != shape:
            raise ValueError(f"pixels must be [..., {', '.join(map(str, shape))}], got {list(pixels.shape)}")
        frames = pixels.split(self.image_size, -1)
        return sum(encode(frame) for encode, frame in zip(self.encoders, frames, strict=True))


class CameraDecoders(nn.Module):
    """One decoder for each camera.

    Args:
        decoders: decoders of frames ``[..., 3, S, S]``, one for each camera.
    """

    def __init__(self, decoders: Sequence[nn.Module]):
        super().__init__()
        self.decoders = nn.ModuleList(decoders)

    def forward(
        self, predicted_latent: torch.Tensor, hidden1: torch.Tensor, hidden2: torch.Tensor
    ) -> torch.Tensor:
        """Decode ``[..., Z]`` and ``[..., H]`` twice to frames ``[..., 3, S, cameras * S]``, about 0..1."""
        return torch.cat([decode(predicted_latent, hidden1, hidden2) for decode in self.decoders], -1)
