"""Training of a world model alone (paper, Eq. 4a and 5)."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDictBase

from dynmap_rl.evaluation.errors import prediction_errors
from dynmap_rl.modules.backbones import load_imagenet
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.supervision import parse_supervision
from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.utils.ranks import ranks

from .loop import SAVE_EVERY, fit
from .settings import JointTraining, WorldModelArchitecture, WorldModelTraining


def build_world_model(
    constants: dict, settings: WorldModelArchitecture, episodes: TensorDictBase | None = None
) -> WorldModel:
    """Make a world model with random weights; the encoder ``resnet18_imagenet`` has weights of torchvision.

    Args:
        constants: of the dataset's normalisation, ``{name: {"low": [D], "high": [D]}}``.
        settings: form of the world model.
        episodes: episodes with ``pixels`` ``[..., 3, S, cameras * S]``, which give the size of the frames; by default
            one camera of 64 x 64.

    Raises:
        ValueError: torchvision is missing or does not fit, or its weights cannot be loaded.
    """
    supervision = parse_supervision(settings.supervision)
    height, width = (64, 64) if episodes is None else episodes["pixels"].shape[-2:]
    frames = {"image_size": height, "cameras": width // height}
    model = make_world_model(constants, supervision, architecture=settings.architecture, **frames)
    if settings.architecture == "resnet18_imagenet":
        load_imagenet(model.encoder)
    return model


def train_world_model(
    world_model: WorldModel,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings: WorldModelTraining | None = None,
    *,
    logger: str | None = None,
    by_entry: bool = False,
    save_every: int = SAVE_EVERY,
) -> None:
    """Minimise the losses of Eq. 4a and 5 on augmented windows; a stopped run resumes.

    Args:
        world_model: changed in place; its supervision and form are its own, not those of the settings.
        episodes: ``train`` and ``eval``, ``[E, T]`` with ``pixels`` uint8 ``[E, T, 3, S, cameras * S]``, ``action`` ``[E, T, A]``,
            ``goal`` ``[E, T, G]`` and ``("dynamics", quantity)`` ``[E, T, D]`` (SI units) for each supervised quantity.
        folder: run folder; gets ``metrics.jsonl`` and the training state.
        settings: sizes, weights and learning rate; default :class:`WorldModelTraining`, whose augmentation is for tasks of cart
            and block: for others, and for robot datasets, set it to ``Augmentation.off()``.
        logger: ``tensorboard``, ``wandb``, ``trackio`` or None.
        by_entry: log held-out errors for every entry of the dynamics, as robot datasets need.
        save_every: updates between training states.

    Raises:
        ValueError: the loss is not finite or diverges; the last training state is kept.
    """
    settings = settings or WorldModelTraining()
    train = episodes["train"]
    if settings.labelled < 1:
        chosen, found = choose_labelled(train, settings.labelled, settings.seed), train.get("labelled", None)
        train = train.copy().set(
            "labelled", chosen if found is None else chosen & found.reshape(*train.shape, -1)
        )
    fit(
        world_model,
        lambda generator: make_loss(world_model, settings, generator),
        train,
        lambda: prediction_errors(world_model, episodes["eval"], by_entry=by_entry),
        folder,
        settings,
        settings.seed,
        logger,
        save_every,
    )


def choose_labelled(episodes: TensorDictBase, share: float, seed: int) -> torch.Tensor:
    """Draw the episodes whose dynamics are used, at least one.

    Args:
        episodes: ``[E, T]``; pieces with the same ``episode`` are drawn together.
        share: share of the episodes.
        seed: seed of the draw. A smaller share of the same seed is a part of a larger one.

    Returns:
        Bool ``[E, T, 1]``.
    """
    count, steps = episodes.shape
    index = episodes.get("episode", None)
    index = torch.arange(count) if index is None else index[:, 0].cpu()
    unique = index.unique()
    order = torch.randperm(len(unique), generator=torch.Generator().manual_seed(seed))
    chosen = torch.isin(index, unique[order[: max(1, round(share * len(unique)))]])
    return chosen.to(episodes["pixels"].device)[:, None, None].expand(count, steps, 1)


def make_loss(
    world_model: WorldModel, settings: WorldModelTraining | JointTraining, generator: torch.Generator
) -> WorldModelLoss:
    """Make the world model's loss module, whose decoded frames ``generator`` draws; processes share them."""
    weights = {"beta_z": settings.beta_z, "beta_dynamics": settings.beta_dynamics, "rarity": settings.rarity}
    if isinstance(settings, WorldModelTraining):
        weights |= {"imagined": settings.imagined, "beta_rgb": settings.beta_rgb}
    frames = max(1, settings.rgb_frames // ranks())
    return WorldModelLoss(world_model, **weights, rgb_frames=frames, generator=generator, distributed=True)
