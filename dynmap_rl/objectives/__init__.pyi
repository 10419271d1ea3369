from .imitation import ImitationLoss as ImitationLoss
from .imitation import imitation_loss as imitation_loss
from .joint import JointLoss as JointLoss
from .world_model import WorldModelLoss as WorldModelLoss
