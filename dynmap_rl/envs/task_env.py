"""Any task as a Gymnasium environment, with the observations of its datasets."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from .protocol import check_action, check_world
from .tasks import get_task


class TaskEnv(gym.Env):
    """One world of any task, such as ``mujoco:FetchSlide`` or one of your own.

    The class :class:`dynmap_rl.envs.DynmapEnv` has more for the tasks of cart and block.

    Action: float32 ``(A,)`` within the limits of the task's layout; actions beyond are cut.

    Observation: dict of ``pixels``, itself a dict with a frame uint8 ``(S, S, 3)`` for each camera, and ``agent_pos``,
    float32, all that a policy may read besides the frames; the goal stands last.

    Info: ``is_success`` (bool), in the last step only, ``dropped`` (bool) and ``position_error`` (float32, m).

    End: the episode is truncated after the steps of the layout, and terminates where the task says that it has failed.

    Args:
        task: name of the task.
        render_mode: ``rgb_array`` or None.
        render_size: side of the picture that ``render()`` returns, in pixels; it is the first camera's frame, enlarged by
            a whole number.

    Raises:
        ValueError: an argument is not valid.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, task: str, render_mode: str | None = None, render_size: int = 256):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be rgb_array or None, got {render_mode!r}")
        self.task, self.render_mode, self.render_size = get_task(task), render_mode, render_size
        self.task_description, layout = self.task.description, self.task.layout
        self.metadata = self.metadata | {"render_fps": layout.fps}
        self._max_episode_steps = layout.steps
        limit = np.array(layout.action_limit, np.float32)
        self.action_space = spaces.Box(-limit, limit, dtype=np.float32)
        frame = spaces.Box(0, 255, (layout.image_size, layout.image_size, 3), np.uint8)
        self.observation_space = spaces.Dict(
            {
                "pixels": spaces.Dict({camera: frame for camera in layout.cameras}),
                "agent_pos": spaces.Box(-np.inf, np.inf, (len(layout.state),), np.float32),
            }
        )
        self._draw, self.world, self._checked = self.task.make_renderer(), None, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Begin the episode of a scene seed; without one, of a random seed.

        Raises:
            ValueError: there are options, which scenes of this environment do not have; or what the task returns is not
                of its layout.
        """
        if options:
            raise ValueError(
                f"this environment has no reset options, got {sorted(options)}; those of cart and block have them in "
                "DynmapEnv, such as dynmap_rl/BalanceReaching-v1"
            )
        super().reset(seed=seed)
        scene_seed = int(self.np_random.integers(2**63)) if seed is None else seed
        self.world = self.task.begin(scene_seed, None, self.world)
        if not self._checked:
            check_world(self.task, self.world, np.array(self._draw(self.world)), state=False)
            self._checked = True
        return self._observe(), self._info()

    def step(self, action: np.ndarray):
        if self.world is None:
            raise gym.error.ResetNeeded("the environment has not begun; call reset first")
        task, space = self.task, self.action_space
        if np.shape(action) != space.shape:
            raise ValueError(f"an action must have the shape {space.shape}, got {np.shape(action)}")
        action = check_action(action, len(space.low)).clip(space.low, space.high)
        self.task.step([self.world], [action])
        truncated = self.world.steps >= self._max_episode_steps
        reward = float(task.reward(self.world))
        return self._observe(), reward, task.is_over(self.world), truncated, self._info()

    def render(self) -> np.ndarray | None:
        """uint8 ``[render_size, render_size, 3]``, or the next smaller multiple of a frame's side, at least one."""
        if self.render_mode is None:
            return None
        if self.world is None:
            raise gym.error.ResetNeeded("the environment has not begun; call reset first")
        frame = self._frame[:, : self._frame.shape[0]]
        times = max(1, self.render_size // len(frame))
        return frame.repeat(times, 0).repeat(times, 1)

    def close(self) -> None:
        """Close the simulator."""
        if self.world is not None:
            self.task.close(self.world)
            self.world = None

    def _observe(self) -> dict[str, Any]:
        cameras = self.task.layout.cameras
        self._frame = np.array(self._draw(self.world))  # a copy: a renderer may use one array
        frames = np.split(self._frame, len(cameras), axis=1)
        pixels = {name: frame.copy() for name, frame in zip(cameras, frames, strict=True)}
        return {"pixels": pixels, "agent_pos": np.asarray(self.task.agent_pos(self.world), np.float32)}

    def _info(self) -> dict[str, bool | np.float32]:
        world = self.world
        ended = world.steps >= self._max_episode_steps
        return {
            "is_success": bool(ended and self.task.is_success(world)),
            "dropped": bool(world.dropped),
            "position_error": np.float32(world.position_error),
        }
