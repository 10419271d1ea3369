"""Training loops that the recipes share: the world model alone, and a policy on a frozen world model's states."""

from __future__ import annotations

from pathlib import Path

from tensordict import TensorDictBase

from dynmap_rl.evaluation.errors import prediction_errors
from dynmap_rl.modules.world_model import WorldModel
from .loop import _fit, _has_no_task, _make_loss


def train_world_model(
    world_model: WorldModel,
    episodes: dict[str, TensorDictBase],
    folder: Path,
    settings,
    save_every: int = 250,
) -> None:
    """Minimise Eq. 4a plus Eq. 5 on augmented windows; a stopped run goes on from its last training state.

    Args:
        world_model: changed in place.
        episodes: ``train`` and ``eval``, ``[E, T]``.
        folder: run folder; gets ``metrics.jsonl`` and the training state.
        settings: with ``updates``, ``windows``, ``window_steps``, ``rgb_steps``, ``distractors``,
            ``learning_rate``, ``beta_z``, ``beta_dynamics`` and ``world_model_seed``. Windows are as they are where its
            ``task`` is none: what may be changed in the frames of others is not known.

    Raises:
        ValueError: the loss is not finite or diverges; the last training state, from before, is kept.
    """

    def held_out() -> dict[str, float]:
        return prediction_errors(world_model, episodes["eval"], by_entry=_has_no_task(settings))

    _fit(
        world_model,
        lambda generator: _make_loss(world_model, settings, generator),
        episodes["train"],
        held_out,
        folder,
        settings,
        settings.world_model_seed,
        save_every,
    )
