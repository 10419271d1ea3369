"""The policy's loss: L1 between expert and predicted action (paper, Sec. III-B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey, unravel_key
from torch.nn import functional as F
from torchrl.objectives.common import LossModule

from dynmap_rl.modules.normalization import Normalizer
from dynmap_rl.modules.policy import FeedforwardPolicy, RecurrentPolicy

from .windows import check_windows


def imitation_loss(
    predicted: torch.Tensor,
    action: torch.Tensor,
    normalizer: Normalizer,
    ignore: torch.Tensor | None = None,
    emphasis: float = 0.0,
    total: Callable[[torch.Tensor], torch.Tensor] = lambda weight: weight,
    within: torch.Tensor | None = None,
) -> torch.Tensor:
    """Return the mean absolute difference of two actions in normalised units, a scalar.

    Args:
        predicted: the policy's actions, ``[B, T, A]`` (SI units).
        action: the demonstrator's actions, ``[B, T, A]`` (SI units).
        normalizer: of the actions.
        ignore: bool ``[B, T, 1]``, steps to leave out because the demonstrator did not act.
        emphasis: every step is weighted by ``1 + emphasis * |a_t - a_{t-1}|`` (normalised, ``a_{-1} = 0``). The world
            model's memory holds the last action, and copying it has a low loss in most steps; the weight stresses
            the steps in which the expert changes its action (keyframe-focused imitation, Wen et al. 2021). A step
            whose last action is not known has the weight 1. 0 is the paper's loss.
        total: function of the sum of the weights, by whose result the loss is divided.
        within: bool ``[B, 1, 1]``, windows that begin within an episode, whose last action is not known.

    Raises:
        ValueError: the two actions have different shapes.
    """
    if predicted.shape != action.shape:
        raise ValueError(f"actions must be {list(predicted.shape)} as the policy's, got {list(action.shape)}")
    error = ((predicted - action) / normalizer.scale).abs().mean(-1, keepdim=True)
    weight = torch.ones_like(error)
    if emphasis:
        before = F.pad(action[:, :-1], (0, 0, 1, 0))
        change = ((action - before) / normalizer.scale).abs().mean(-1, keepdim=True)
        if ignore is not None:
            change = torch.where(F.pad(ignore[:, :-1], (0, 0, 1, 0)), 0.0, change)
        if within is not None:
            change[:, :1] = torch.where(within, 0.0, change[:, :1])
        weight = weight + emphasis * change
    if ignore is not None:  # not by a product, since ignored entries may be NaN
        error, weight = (torch.where(ignore, 0.0, x) for x in (error, weight))
    return (error * weight).sum() / total(weight.sum()).clamp_min(1)


def find_target(
    tensordict: TensorDictBase,
    action: NestedKey = "action",
    expert_action: NestedKey = "expert_action",
    disturbed: NestedKey = "disturbed",
    masks: tuple[NestedKey, ...] = (),
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the actions to imitate, ``[B, T, A]``, and the steps to leave out, bool ``[B, T, 1]`` or None.

    Args:
        tensordict: ``[B, T]``.
        action: key of the executed actions.
        expert_action: key of what the demonstrator would have done. Where it is missing, executed actions are
            imitated, except in disturbed steps.
        disturbed: key of the steps in which the demonstrator did not act.
        masks: keys of masks that are false for invalid steps.
    """
    target, ignore = tensordict.get(expert_action, None), None
    if target is None:
        target, ignore = tensordict[action], tensordict.get(disturbed, None)
    for key in masks:
        if (mask := tensordict.get(key, None)) is not None:
            invalid = ~mask.reshape(*tensordict.shape, 1)
            ignore = invalid if ignore is None else ignore | invalid
    return target, ignore


def begins_within(tensordict: TensorDictBase, step_count: NestedKey = "step_count") -> torch.Tensor | None:
    """Return which windows ``[B, T]`` begin after the first step of their episode, bool ``[B, 1, 1]``, if it is known."""
    steps = tensordict.get(step_count, None)
    return None if steps is None else steps.reshape(*tensordict.shape, 1)[:, :1] > 0


class ImitationLoss(LossModule):
    """L1 loss of a policy on latents and hidden states (paper, Sec. III-B); see :func:`imitation_loss`.

    Input ``[B, T]``: ``latent``, ``hidden1``, ``hidden2``, ``goal`` and the demonstrator's ``action`` (SI units).
    Optional: ``expert_action`` to imitate in the place of ``action``, or ``disturbed`` bool ``[B, T, 1]``, the steps to
    leave out (see :func:`find_target`), a mask of valid steps as in :class:`dynmap_rl.objectives.WorldModelLoss`, and
    ``step_count`` int ``[B, T, 1]``, the number of the step in its episode; without it, windows begin their episodes.

    Output: ``loss_policy``, a scalar.

    Args:
        policy: policy to train; any module with the same inputs whose ``action`` is the normalizer of its actions.
        emphasis: see :func:`imitation_loss`.

    Raises:
        TypeError: the policy has no ``action``.
        ValueError: the input is not windows ``[B, T]`` of one episode each.
    """

    @dataclass
    class _AcceptedKeys:
        latent: NestedKey = "latent"
        hidden1: NestedKey = "hidden1"
        hidden2: NestedKey = "hidden2"
        goal: NestedKey = "goal"
        action: NestedKey = "action"
        expert_action: NestedKey = "expert_action"
        disturbed: NestedKey = "disturbed"
        step_count: NestedKey = "step_count"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(self, policy: FeedforwardPolicy | RecurrentPolicy, emphasis: float = 0.0):
        super().__init__()
        if not isinstance(getattr(policy, "action", None), Normalizer):
            raise TypeError(f"policy must have a Normalizer as its action, got {type(policy).__name__}")
        self.policy, self.emphasis = policy, emphasis

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that the loss reads."""
        keys = self.tensor_keys
        return [unravel_key(k) for k in (keys.latent, keys.hidden1, keys.hidden2, keys.goal, keys.action)]

    @property
    def out_keys(self) -> list[str]:
        """Keys that the loss writes."""
        return ["loss_policy"]

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return the loss."""
        masks = self._loss_mask_keys()
        check_windows(tensordict, masks=masks)
        keys = self.tensor_keys
        states = (tensordict[key] for key in self.in_keys[:-1])
        target, ignore = find_target(tensordict, keys.action, keys.expert_action, keys.disturbed, masks)
        loss = imitation_loss(
            self.policy(*states), target, self.policy.action, ignore, self.emphasis,
            within=begins_within(tensordict, keys.step_count),
        )  # fmt: skip
        return TensorDict({"loss_policy": loss}, [])
