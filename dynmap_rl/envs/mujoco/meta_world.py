"""Two tasks of Meta-World (Yu et al. 2019) without grasping, with the benchmark's scripted experts.

A demonstration is a success if any of its steps is one, as the benchmark counts.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from .bodies import Body
from .rendering import Camera
from .task import MujocoTask, MujocoWorld


class MetaWorldTask(MujocoTask):
    """Task of Meta-World.

    Action, within -1 to 1: x, y and z of the hand's target, 10 mm a step each, and the gripper's effort.

    Success: the benchmark's own condition has held in any step so far.

    Attributes:
        environment: name of the environment in Meta-World.
    """

    environment: str
    fps = 80
    hide = ("mocap",)
    robot = "sawyer"

    def make(self) -> gymnasium.Env:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

        env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{self.environment}-goal-observable"]()
        env._freeze_rand_vec, env.seeded_rand_vec = False, True  # starts from the seed, not from a list
        return env

    def reset(self, env: gymnasium.Env, seed: int) -> tuple[Any, dict]:
        env.seed(seed % 2**32)  # reset(seed=...) is without effect
        return env.reset()

    def goal(self, world: MujocoWorld) -> np.ndarray:
        return world.env._target_pos

    def is_success(self, world: MujocoWorld) -> bool:
        return world.solved

    def demonstrator(self, world: MujocoWorld) -> Callable[[], np.ndarray]:
        from metaworld.policies import ENV_POLICY_MAP

        warnings.filterwarnings(
            "ignore", r"Constant\(s\) may be too high", UserWarning
        )  # of an action above 1
        policy = ENV_POLICY_MAP[self.environment]()
        return lambda: np.clip(policy.get_action(world.observation), -1, 1)


class PlateSlide(MetaWorldTask):
    """Slide a plate on the table into a cabinet."""

    name = "plate_slide"
    description = "Slide the plate into the white cabinet."
    environment = "plate-slide-v3"
    steps = 80
    bodies = (Body("puck", orientation="axis"), Body("hand", orientation="none"))
    keep = ("puck_goal",)
    views = (
        Camera("front", (0.0, 0.74, 0.05), 0.65, -90, -50),
        Camera("side", (0.0, 0.74, 0.05), 0.65, 0, -40),
    )


class Soccer(MetaWorldTask):
    """Kick a ball into a goal."""

    name = "soccer"
    description = "Kick the ball into the goal."
    environment = "soccer-v3"
    steps = 120
    bodies = (Body("ball", "soccer_ball", "none"), Body("hand", orientation="none"))
    keep = ("soccer_goal",)
    views = (  # from the side first: from the front, the goal hides the ball
        Camera("side", (0.0, 0.74, 0.02), 0.6, 0, -50),
        Camera("front", (0.0, 0.74, 0.05), 0.65, -90, -50),
    )
