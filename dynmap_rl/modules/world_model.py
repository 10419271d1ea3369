"""The world model: encoder, transition and decoders, and its normalisation constants (paper, Sec. III-A)."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from numbers import Integral

import torch
from torch import nn

from .backbones import ResNetEncoder, ViTEncoder
from .cameras import CameraDecoders, CameraEncoders
from .decoder import DynamicsDecoder, PlainDecoder, SpriteDecoder
from .encoder import GlimpseEncoder, PlainEncoder
from .normalization import Normalizer
from .precision import mixed_precision
from .recurrent import State
from .transition import Transition

ARCHITECTURES = {
    "plain": (PlainEncoder, PlainDecoder),
    "glimpse": (GlimpseEncoder, SpriteDecoder),
    "resnet18": (ResNetEncoder, SpriteDecoder),
    "resnet18_imagenet": (partial(ResNetEncoder, imagenet=True), SpriteDecoder),
    "vit": (ViTEncoder, SpriteDecoder),
}


class WorldModel(nn.Module):
    """Encoder, transition and decoders.

    Weights and memories are float32; for speed, frames can be encoded under ``torch.autocast`` (see :meth:`encode`).

    Args:
        action: normaliser of the actions.
        dynamics: normaliser of each supervised quantity: any of position, velocity, acceleration, or none.
        latent_size: Z.
        hidden_size: H.
        architecture: ``plain``, plain CNNs (:class:`PlainEncoder`, :class:`PlainDecoder`), ``glimpse``
            (:class:`GlimpseEncoder`, :class:`SpriteDecoder`), or, with the decoder of ``glimpse``, ``resnet18``,
            ``resnet18_imagenet`` (:class:`ResNetEncoder`, which has random weights here in both cases) or ``vit``
            (:class:`ViTEncoder`).
        image_size: side S of the frames of a camera, a multiple of 8.
        cameras: number of cameras, whose frames stand side by side; each has an encoder and a decoder of its own.

    Raises:
        ValueError: the architecture is unknown, or a size is wrong.
    """

    def __init__(
        self,
        action: Normalizer,
        dynamics: Mapping[str, Normalizer],
        latent_size: int = 64,
        hidden_size: int = 128,
        architecture: str = "glimpse",
        image_size: int = 64,
        cameras: int = 1,
    ):
        super().__init__()
        if architecture not in ARCHITECTURES:
            raise ValueError(f"architecture must be one of {', '.join(ARCHITECTURES)}, got {architecture!r}")
        self.latent_size, self.hidden_size, self.architecture = latent_size, hidden_size, architecture
        self.image_size, self.cameras = image_size, cameras
        for name in ("latent_size", "hidden_size", "image_size", "cameras"):
            if not isinstance(size := getattr(self, name), Integral) or size < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {size}")
        if image_size % 8:
            raise ValueError(f"image_size must be a multiple of 8, got {image_size}")
        encoder, decoder = ARCHITECTURES[architecture]
        encoders = [encoder(latent_size, image_size=image_size) for _ in range(cameras)]
        self.encoder = encoders[0] if cameras == 1 else CameraEncoders(encoders, image_size)
        self.transition = Transition(action, latent_size, hidden_size)
        decoders = [decoder(latent_size + 2 * hidden_size, image_size=image_size) for _ in range(cameras)]
        self.image_decoder = decoders[0] if cameras == 1 else CameraDecoders(decoders)
        self.dynamics_decoder = DynamicsDecoder(latent_size + 2 * hidden_size, dynamics)

    @property
    def supervision(self) -> tuple[str, ...]:
        """Quantities that are decoded, in the paper's order."""
        return self.dynamics_decoder.quantities

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of entries D of the quantities that are decoded."""
        return {name: normalizer.size for name, normalizer in self.dynamics_decoder.normalizers.items()}

    def encode(self, pixels: torch.Tensor, mixed: bool = False) -> torch.Tensor:
        """Encode frames ``[..., 3, S, cameras * S]`` as latents ``[..., Z]``: ``z_t = ENC(I_t)``.

        Args:
            pixels: frames, 0..255.
            mixed: use the precision of training (:func:`mixed_precision`), which is faster.
        """
        if not mixed:
            return self.encoder(pixels)
        with mixed_precision(pixels.device):
            return self.encoder(pixels).float()

    def predict(
        self, latent: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Predict ``predicted_latent``, ``hidden1``, ``hidden2`` of a sequence (see :meth:`Transition.forward`)."""
        return self.transition(latent, action)

    def step(self, latent: torch.Tensor, action: torch.Tensor, state: State) -> tuple[torch.Tensor, State]:
        """Predict one step (see :meth:`Transition.step`)."""
        return self.transition.step(latent, action, state)

    def initial_state(self, batch: int, device=None) -> State:
        """Return ``h_0 = 0`` of B episodes."""
        return self.transition.lstm.initial_state(batch, device)

    def decode_pixels(self, predicted_latent, hidden1, hidden2) -> torch.Tensor:
        """Decode predicted frames ``[..., 3, S, cameras * S]`` in about 0..1, not clipped."""
        return self.image_decoder(predicted_latent, hidden1, hidden2)

    def decode_dynamics(self, predicted_latent, hidden1, hidden2) -> dict[str, torch.Tensor]:
        """Decode predicted dynamics ``[..., D]`` by quantity (SI units)."""
        values = self.dynamics_decoder(predicted_latent, hidden1, hidden2)
        return dict(zip(self.supervision, values, strict=True))
