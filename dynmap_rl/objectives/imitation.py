"""The policy's loss: L1 between expert and predicted action (paper, Sec. III-B)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch.nn import functional as F
from torchrl.objectives.common import LossModule

from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.policy import FeedforwardPolicy, RecurrentPolicy


def imitation_loss(
    predicted: torch.Tensor,
    action: torch.Tensor,
    normalizer: Normalizer,
    ignore: torch.Tensor | None = None,
    emphasis: float = 0.0,
) -> torch.Tensor:
    """Mean absolute difference of two actions ``[B, T, A]`` (SI units), in normalised units: a scalar.

    Args:
        ignore: bool ``[B, T, 1]``, steps that do not count (the demonstrator did not act in them).
        emphasis: steps count ``1 + emphasis * |a_t - a_{t-1}|`` times (normalised, ``a_{-1} = 0``). The world model's
            memory holds the last action, and copying it is nearly right in most steps; this gives weight to those in
            which the expert decides (keyframe-focused imitation, Wen et al. 2021). 0 is the paper's loss.
    """
    error = ((predicted - action) / normalizer.scale).abs().mean(-1, keepdim=True)
    weight = torch.ones_like(error)
    if emphasis:
        before = F.pad(action[:, :-1], (0, 0, 1, 0))
        weight = weight + emphasis * ((action - before) / normalizer.scale).abs().mean(-1, keepdim=True)
    if ignore is not None:  # by choice, not by a product: what is ignored may be NaN
        error, weight = (torch.where(ignore, 0.0, x) for x in (error, weight))
    return (error * weight).sum() / weight.sum().clamp_min(1)


def find_ignored(
    tensordict: TensorDictBase, disturbed: NestedKey, masks: tuple[NestedKey, ...]
) -> torch.Tensor | None:
    """Bool ``[B, T, 1]``: the steps that are disturbed or that a mask marks as invalid; None where there is neither."""
    ignore = tensordict.get(disturbed, None)
    for key in masks:
        if (mask := tensordict.get(key, None)) is not None:
            invalid = ~mask.reshape(*tensordict.shape, 1)
            ignore = invalid if ignore is None else ignore | invalid
    return ignore


class ImitationLoss(LossModule):
    """:func:`imitation_loss` of a policy on latents and hidden states (paper, Sec. III-B).

    Input ``[B, T]``: ``latent``, ``hidden1``, ``hidden2``, ``goal``, the demonstrator's ``action`` (SI units) and,
    optional, ``disturbed`` bool ``[B, T, 1]``: the steps that do not count. A mask of valid steps is optional too, as in
    :class:`dynmap_rl.objectives.WorldModelLoss`.

    Output: ``loss_policy``, a scalar.

    Args:
        policy: what is trained.
        emphasis: see :func:`imitation_loss`.
    """

    @dataclass
    class _AcceptedKeys:
        latent: NestedKey = "latent"
        hidden1: NestedKey = "hidden1"
        hidden2: NestedKey = "hidden2"
        goal: NestedKey = "goal"
        action: NestedKey = "action"
        disturbed: NestedKey = "disturbed"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, policy: FeedforwardPolicy | RecurrentPolicy, emphasis: float = 0.0):
        super().__init__()
        self.policy, self.emphasis = policy, emphasis

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads, as ``set_keys`` names it."""
        keys = self.tensor_keys
        return [unravel_key(k) for k in (keys.latent, keys.hidden1, keys.hidden2, keys.goal, keys.action)]

    @property
    def out_keys(self) -> list[str]:
        """The loss."""
        return ["loss_policy"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        *states, action = (tensordict[key] for key in self.in_keys)
        ignore = find_ignored(tensordict, self.tensor_keys.disturbed, self._loss_mask_keys())
        loss = imitation_loss(self.policy(*states), action, self.policy.action, ignore, self.emphasis)
        return TensorDict({"loss_policy": loss}, [])
