"""Loss of joint and end-to-end training (paper, Eq. 3 and 4)."""

from __future__ import annotations

from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torchrl.objectives.common import LossModule

from dynmap_rl.modules.policy import FeedforwardPolicy, RecurrentPolicy
from dynmap_rl.utils.ranks import mean_over_ranks

from .imitation import begins_within, find_target, imitation_loss
from .windows import check_windows
from .world_model import WorldModelLoss


class JointLoss(LossModule):
    """Loss of world model and policy: Eq. 4 with the dynamics terms of Eq. 5, or Eq. 3.

    The gradient of the policy's loss reaches encoder and transition.

    Input: the input of :class:`WorldModelLoss` and ``goal`` ``[B, T, G]``. Optional: ``expert_action``
    to imitate in the place of ``action``, or ``disturbed`` bool ``[B, T, 1]``, the steps that the policy's loss leaves
    out (see :func:`find_target`), as it leaves out steps that a mask marks as invalid, and ``step_count`` (see
    :class:`ImitationLoss`).

    Output: ``loss_policy`` (times ``beta_joint``) and, except for end-to-end training, the world model's losses.

    Args:
        world_model_loss: loss of the world model, which holds the world model.
        policy: policy to train.
        beta_joint: weight of the policy's loss.
        emphasis: see :func:`imitation_loss`.
        end_to_end: minimise the policy's loss alone (Eq. 3).

    Raises:
        ValueError: the input is not windows ``[B, T]`` of one episode each, or ``world_model_loss`` has ``imagined``: a
            policy's states are those of the frames.
    """

    @dataclass
    class _AcceptedKeys:
        pixels: NestedKey = "pixels"
        action: NestedKey = "action"
        dynamics: NestedKey = "dynamics"
        labelled: NestedKey = "labelled"
        goal: NestedKey = "goal"
        expert_action: NestedKey = "expert_action"
        disturbed: NestedKey = "disturbed"
        step_count: NestedKey = "step_count"

    tensor_keys: _AcceptedKeys
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
        if world_model_loss.imagined:
            raise ValueError(f"world_model_loss must have imagined = 0, got {world_model_loss.imagined}")
        self.world_model_loss, self.policy = world_model_loss, policy
        self.beta_joint, self.emphasis, self.end_to_end = beta_joint, emphasis, end_to_end
        super().set_keys(**vars(world_model_loss.tensor_keys))

    def set_keys(self, **kwargs) -> None:
        """Set keys of this loss and of the world model's loss."""
        super().set_keys(**kwargs)
        own = ("goal", "expert_action", "disturbed", "step_count")
        self.world_model_loss.set_keys(**{k: v for k, v in kwargs.items() if k not in own})

    @property
    def loss_mask_key(self) -> NestedKey | None:
        """Key of the mask of valid steps (see :class:`torchrl.objectives.LossModule`)."""
        return self.world_model_loss.loss_mask_key

    @loss_mask_key.setter
    def loss_mask_key(self, key: NestedKey | None) -> None:
        self.world_model_loss.loss_mask_key = key

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads."""
        keys = self.world_model_loss.in_keys
        return [*(keys[:2] if self.end_to_end else keys), unravel_key(self.tensor_keys.goal)]

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes; their sum is to be minimised."""
        return [*([] if self.end_to_end else self.world_model_loss.out_keys), "loss_policy"]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the losses."""
        keys, masks = self.tensor_keys, self.world_model_loss._loss_mask_keys()
        check_windows(tensordict, 1 if self.end_to_end else 2, masks)
        latent, states = self.world_model_loss.predict(tensordict)
        losses = {} if self.end_to_end else self.world_model_loss.compare(tensordict, latent, states)
        predicted = self.policy(latent, *states[1:], tensordict[keys.goal])
        target, ignore = find_target(tensordict, keys.action, keys.expert_action, keys.disturbed, masks)
        # Divided by the same number in all processes, so that the mean of their losses is the loss of the whole batch.
        total = mean_over_ranks if self.world_model_loss.sums_over_ranks() else (lambda weight: weight)
        within = begins_within(tensordict, keys.step_count)
        loss = imitation_loss(predicted, target, self.policy.action, ignore, self.emphasis, total, within)
        return TensorDict({**losses, "loss_policy": self.beta_joint * loss}, [])
