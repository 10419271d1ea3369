"""Losses."""

from .imitation import imitation_loss
from .world_model import WorldModelLoss

__all__ = ["WorldModelLoss", "imitation_loss"]
