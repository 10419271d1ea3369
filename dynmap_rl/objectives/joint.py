"""World model and policy in one loss: joint and end-to-end training (paper, Eq. 3 and 4)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.objectives.common import LossModule

from dynmap_rl.modules import FeedforwardPolicy, RecurrentPolicy

from .imitation import imitation_loss
from .world_model import WorldModelLoss


class JointLoss(LossModule):
    """Eq. 4 with the dynamics terms of Eq. 5, or Eq. 3: the policy's loss reaches encoder and transition.

    Input: that of :class:`WorldModelLoss`, with ``goal`` ``[B, T, G]`` and, optional, ``disturbed`` bool
    ``[B, T, 1]``: the steps that imitation leaves out.

    Output: ``loss_policy`` (times ``beta_joint``) and, but for end-to-end training, the world model's losses.

    Args:
        world_model_loss: with the world model.
        policy: trained with it.
        beta_joint: weight of the policy's loss.
        emphasis: see :func:`imitation_loss`.
        end_to_end: the policy's loss alone (Eq. 3).
    """

    @dataclass
    class _AcceptedKeys:
        goal: NestedKey = "goal"
        disturbed: NestedKey = "disturbed"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        world_model_loss: WorldModelLoss,
        policy: FeedforwardPolicy | RecurrentPolicy,
        beta_joint: float = 1.0,
        emphasis: float = 0.0,
        end_to_end: bool = False,
    ):
        super().__init__()
        self.world_model_loss, self.policy = world_model_loss, policy
        self.beta_joint, self.emphasis, self.end_to_end = beta_joint, emphasis, end_to_end

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        latent, states = self.world_model_loss.predict(tensordict)
        losses = {} if self.end_to_end else self.world_model_loss.compare(tensordict, latent, states)
        predicted = self.policy(latent, *states[1:], tensordict.get(self.tensor_keys.goal))
        action = tensordict.get(self.world_model_loss.tensor_keys.action)
        ignore = tensordict.get(self.tensor_keys.disturbed, None)
        loss = imitation_loss(predicted, action, self.policy.action, ignore, self.emphasis)
        return TensorDict({**losses, "loss_policy": self.beta_joint * loss}, [])
