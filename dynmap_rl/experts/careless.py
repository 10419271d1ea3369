"""Baseline that pays no attention to the block: what the cart's limits alone do for its balance."""

from __future__ import annotations

import math

import torch
from torch import nn

from dynmap_rl.envs.protocol import BaseTask
from dynmap_rl.envs.scene import BinScene
from dynmap_rl.envs.task import Task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, CONTROL_DT, VELOCITY_LIMIT

ABOVE_BIN = 0.12  # m, height of the cart's centre over the bin's opening when it tips the block
TIPPED = math.pi / 3  # rad


class CarelessController(nn.Module):
    """Full acceleration towards the goal, then full brake, along every axis; the block is ignored.

    In task 2 it goes from point to point of the way around the obstacle. In task 3 it goes to a place above the bin
    and tilts the cart there. It has the form of an :class:`dynmap_rl.experts.ExpertNetwork`.

    Args:
        task: task that it plays, whose state it reads.

    Raises:
        ValueError: the task is not one of cart and block.
    """

    def __init__(self, task: BaseTask):
        super().__init__()
        if not isinstance(task, Task):
            raise ValueError(f"the careless controller plays tasks of cart and block, got {task.name}")
        self.tips = issubclass(task.ranges.scene, BinScene)
        self.register_buffer("limit", torch.as_tensor(ACCELERATION_LIMIT, dtype=torch.float32))
        self.register_buffer("speed", torch.as_tensor(VELOCITY_LIMIT, dtype=torch.float32))

    def forward(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return acceleration ``[..., 3]`` (m/s^2, m/s^2, rad/s^2), and zeros, for states ``[..., S]``.

        See :func:`dynmap_rl.envs.task.base_state` for the scales of the state.
        """
        distance = torch.cat([state[..., :2], -state[..., 4:5]], -1) / 2  # to the goal, upright
        if self.tips:
            distance = distance + distance.new_tensor([0.0, ABOVE_BIN, 0.0])
            there = (distance[..., :2].abs() < 0.02).all(-1)
            distance[..., 2] += TIPPED * there
        velocity = state[..., 5:8] * self.speed
        braking = velocity * velocity.abs() / (2 * self.limit)  # distance covered until it stands
        full = torch.sign(distance - braking) * self.limit
        stop = (distance / CONTROL_DT - velocity) / CONTROL_DT
        # Near the goal and slow, one step suffices; otherwise it would swing around the goal for ever.
        near = (distance.abs() < self.limit * CONTROL_DT**2) & (velocity.abs() <= self.limit * CONTROL_DT)
        acceleration = torch.where(near, stop.clamp(-self.limit, self.limit), full)
        return acceleration, torch.zeros_like(acceleration)
