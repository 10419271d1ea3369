"""The Gymnasium environments as LeRobot's robot ``dynmap``, which moves in real time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from lerobot.robots import Robot, RobotConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.keys import CAMERA, FRAME_SHAPE, GYMNASIUM_IDS

from .environment import DynmapEnvConfig, make_env

STATE = "step", *LAYOUT.state
ACTION = LAYOUT.action
FRONT = CAMERA.rpartition(".")[2]
HOLD = np.zeros(len(ACTION), np.float32)


@RobotConfig.register_subclass("dynmap")
@dataclass(kw_only=True)
class DynmapRobotConfig(RobotConfig):
    """Settings of ``--robot.type=dynmap``.

    Attributes:
        task: ``balance_reaching``, ``balance_reaching_obstacle`` or ``bin_dropping``.
        split: split of the scenes.
        scene: number of the scene in the split.
    """

    task: str = "balance_reaching"
    split: str = "test"
    scene: int = 0

    def __post_init__(self):
        super().__post_init__()
        if self.task not in GYMNASIUM_IDS:
            raise ValueError(f"--robot.task must be one of {', '.join(GYMNASIUM_IDS)}, got {self.task!r}")


class DynmapRobot(Robot):
    """One episode of a task, in control steps of 50 ms by the clock, as a robot of LeRobot.

    Time begins with the first action. An action lasts for one control step, and the frame at its beginning is what the
    robot sees until the next action. Where no action comes in time, the robot holds its commanded pose for a step.
    After the episode's end, it does not move any more.

    The state is the commanded pose (m, m, rad) and the goal (m), as in the datasets. In front of it is the number of
    the last action, by which a policy knows the step of a frame. It also tells frames of a robot at rest apart, of
    which LeRobot's policy server would skip all but the first.

    Attributes:
        info: ``info`` of the Gymnasium environment after the last finished step.
        held: number of steps for which no action came.
        over: whether the episode is over.
    """

    config_class = DynmapRobotConfig
    name = "dynmap"

    def __init__(self, config: DynmapRobotConfig):
        super().__init__(config)
        self.config = config
        self._env = None

    @property
    def observation_features(self) -> dict:
        return dict.fromkeys(STATE, float) | {FRONT: FRAME_SHAPE}

    @property
    def action_features(self) -> dict:
        return dict.fromkeys(ACTION, float)

    @property
    def is_connected(self) -> bool:
        return self._env is not None

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None:
        """Do nothing, as there is nothing to calibrate."""

    def configure(self) -> None:
        """Do nothing, as there is nothing to configure."""

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Begin the episode."""
        settings = DynmapEnvConfig(task=self.config.task, split=self.config.split)
        self._env = make_env(settings.gym_id, settings.gym_kwargs, settings.split)
        self._seen, self.info = self._env.reset(seed=self.config.scene)
        self._action, self._begun = None, None
        self._sent, self.held, self.over = 0, 0, False

    def disconnect(self) -> None:
        """Close the environment; ``info`` remains."""
        if self._env is not None:
            self._env.close()
            self._env = None

    @check_if_not_connected
    def get_observation(self) -> dict:
        """Return state and frame at the beginning of the present step."""
        self._hold_until(time.perf_counter())
        values = [max(self._sent - 1, 0), *self._seen["agent_pos"].tolist()]
        return dict(zip(STATE, map(float, values), strict=True)) | {FRONT: self._seen["pixels"]}

    @check_if_not_connected
    def send_action(self, action: dict) -> dict:
        """Begin a step with an action (m, m, rad)."""
        now = time.perf_counter()
        self._hold_until(now)
        self._begin(np.array([action[name] for name in ACTION], np.float32), now)
        self._sent += 1
        return action

    def _hold_until(self, now: float) -> None:
        """Hold the pose in the steps for which no action has come."""
        while self._begun is not None and not self.over and now >= self._begun + 1.5 * CONTROL_DT:
            self._begin(HOLD, self._begun + CONTROL_DT)
            self.held += 1

    def _begin(self, action: np.ndarray, now: float) -> None:
        """End the present step, and begin the next."""
        if self._action is not None and not self.over:
            self._seen, _, terminated, truncated, self.info = self._env.step(self._action)
            self.over = terminated or truncated
        self._action, self._begun = action, now
