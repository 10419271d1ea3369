"""Networks of torchvision as encoders: a ResNet-18 and a small vision transformer."""

from __future__ import annotations

import torch
from torch import nn

from .encoder import Encoder
from .layers import ChannelNorm

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's frames in 0..1


class BackboneEncoder(Encoder):
    """Base of encoders with a network of torchvision, which reads frames normalised as ImageNet's.

    Args:
        image_size: side S of the frames, a multiple of 32.

    Raises:
        ValueError: torchvision cannot be imported, or the frames have another size.
    """

    def __init__(self, image_size: int):
        super().__init__(image_size)
        if image_size % 32:
            raise ValueError(f"the side of the frames must be a multiple of 32, got {image_size}")
        self.register_buffer("mean", 255 * torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", 255 * torch.tensor(STD).view(3, 1, 1), persistent=False)

    def normalize(self, x: torch.Tensor) -> torch.Tensor:
        """Scale frames ``[N, 3, S, S]`` in 0..255 to the mean 0 and the deviation 1 of ImageNet, channels last."""
        return ((x - self.mean) / self.std).contiguous(memory_format=torch.channels_last)


def load_imagenet(encoder: nn.Module) -> None:
    """Load the weights of torchvision into the ResNets of an encoder.

    Raises:
        ValueError: torchvision is missing, or its weights cannot be loaded.
    """
    for part in encoder.modules():
        if isinstance(part, ResNetEncoder):
            part.load_imagenet()


class ResNetEncoder(BackboneEncoder):
    """ResNet-18 (He et al. 2016) without its last pooling, which would lose the places of things.

    Args:
        latent_size: Z.
        image_size: side S of the frames, a multiple of 32.
        imagenet: use the normalisation that weights of ImageNet need, with fixed statistics
            (:meth:`load_imagenet` loads the weights). Otherwise the norms are over the channels of a pixel, which do not
            depend on the other frames of a batch.
    """

    def __init__(self, latent_size: int = 64, image_size: int = 64, imagenet: bool = False):
        super().__init__(image_size)
        self.body = _body(import_torchvision().models.resnet18(norm_layer=_norm(imagenet)))
        self.project = nn.Linear(512 * (image_size // 32) ** 2, latent_size)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        return self.project(self.body(self.normalize(x)).flatten(1))  # (N, 512, S / 32, S / 32) to (N, Z)

    def load_imagenet(self) -> None:
        """Load torchvision's weights, from its cache or from the internet.

        Raises:
            ValueError: they cannot be loaded.
        """
        models = import_torchvision().models
        try:
            weights = models.ResNet18_Weights.IMAGENET1K_V1.get_state_dict(progress=False, check_hash=True)
        except (OSError, RuntimeError) as error:  # the network, or a damaged file
            raise ValueError(
                f"the weights of ResNet-18 cannot be loaded ({error}); choose the architecture resnet18, which begins "
                "with random weights"
            ) from error
        resnet = models.resnet18(norm_layer=_norm(imagenet=True))
        resnet.load_state_dict(weights)
        self.body.load_state_dict(_body(resnet).state_dict())


def _norm(imagenet: bool) -> type[nn.Module]:
    return import_torchvision().ops.misc.FrozenBatchNorm2d if imagenet else ChannelNorm


def _body(resnet: nn.Module) -> nn.Sequential:
    """Return a ResNet without its last pooling and its classifier."""
    return nn.Sequential(*list(resnet.children())[:-2])


class ViTEncoder(BackboneEncoder):
    """Small vision transformer (Dosovitskiy et al. 2021) with random weights; torchvision's weights are of larger ones.

    Args:
        latent_size: Z.
        image_size: side S of the frames, a multiple of 32.
        patch: side of a patch in pixels of a frame of 64 x 64; there are 64 patches in frames of any size.
        layers: number of layers.
        heads: attention heads of a layer.
        width: size of a token; the MLPs have twice as many hidden units.
    """

    def __init__(
        self,
        latent_size: int = 64,
        image_size: int = 64,
        patch: int = 8,
        layers: int = 4,
        heads: int = 4,
        width: int = 128,
    ):
        super().__init__(image_size)
        models, patch = import_torchvision().models, patch * image_size // 64
        sizes = image_size, patch, layers, heads, width, 2 * width
        self.body = models.VisionTransformer(*sizes, num_classes=latent_size)
        self.body.heads.head.reset_parameters()  # not 0, as for a classifier: latents must differ

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        return self.body(self.normalize(x))  # (N, Z)


def import_torchvision():
    """Return the module torchvision.

    Raises:
        ValueError: it is missing, or built for another torch.
    """
    try:
        import torchvision
        import torchvision.ops.misc
    except (ImportError, OSError, RuntimeError, AttributeError) as error:  # a wrong build raises any of these
        raise ValueError(
            f"the architectures resnet18 and vit need a torchvision that fits torch {torch.__version__} ({error}); "
            "install it, or choose the architecture glimpse or plain"
        ) from error
    return torchvision
