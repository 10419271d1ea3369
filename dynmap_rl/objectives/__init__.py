"""Losses."""

from .imitation import imitation_loss
from .joint import JointLoss
from .world_model import WorldModelLoss

__all__ = ["JointLoss", "WorldModelLoss", "imitation_loss"]
