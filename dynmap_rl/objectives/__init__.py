"""Losses."""

from .imitation import ImitationLoss, imitation_loss
from .joint import JointLoss
from .world_model import WorldModelLoss

__all__ = ["ImitationLoss", "JointLoss", "WorldModelLoss", "imitation_loss"]
