"""Frames of several cameras, side by side: an encoder and a decoder for each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from torch import nn


class CameraEncoders(nn.Module):
    """Sum of the latents of one encoder for each camera, which is one linear map of the features of all.

    The latents are rolled by Z / C entries from camera to camera, so that the first entries of each, which begin as
    positions (:class:`GlimpseEncoder`), are apart.

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
        return self._add(self.encoders, pixels)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        """Encode frames ``[N, 3, S, cameras * S]`` in 0..255 as latents ``[N, Z]``, without cutting N into parts."""
        return self._add([encoder.encode for encoder in self.encoders], x)

    def _add(self, encoders: Iterable[Callable], pixels: torch.Tensor) -> torch.Tensor:
        frames = pixels.split(self.image_size, -1)
        latents = [encode(frame) for encode, frame in zip(encoders, frames, strict=True)]
        step = latents[0].shape[-1] // len(latents)
        return sum(latent.roll(i * step, -1) for i, latent in enumerate(latents))


class CameraDecoders(nn.Module):
    """One decoder for each camera, with the latent rolled back by as much as :class:`CameraEncoders` rolls it.

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
        step = predicted_latent.shape[-1] // len(self.decoders)
        latents = [predicted_latent.roll(-i * step, -1) for i in range(len(self.decoders))]
        frames = [d(z, hidden1, hidden2) for d, z in zip(self.decoders, latents, strict=True)]
        return torch.cat(frames, -1)
