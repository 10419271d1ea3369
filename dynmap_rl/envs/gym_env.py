"""The tasks as Gymnasium environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from .renderer import Renderer, Window
from .scene import SceneRanges, choose_ranges
from .task import Task
from .tasks import get_task
from .world import ACCELERATION_LIMIT, CONTROL_DT, EPISODE_STEPS, VELOCITY_LIMIT, World

ACTION_LIMITS = {"position": VELOCITY_LIMIT * CONTROL_DT, "acceleration": ACCELERATION_LIMIT}
OBS_TYPES = ("state", "pixels", "pixels_agent_pos")


class DynmapEnv(gym.Env):
    """A cart carries a free-standing block over a 1 m x 1 m scene, controlled at 20 Hz.

    Description:
        The block stands on the cart and is held by friction alone. It tips when the cart accelerates faster than
        about ``9.81 * block_width / block_height`` (2.9 to 4.9 m/s^2 in the default ranges), which the cart's limit
        exceeds: only careful control keeps it up. Sizes, positions and colours change with every episode. An
        episode lasts 120 steps (6 s). There are three tasks:
        ``balance_reaching`` (task 1: carry the block to the goal), ``balance_reaching_obstacle`` (task 2: the same
        around an obstacle) and ``bin_dropping`` (task 3: tip the block into a bin).

    Action:
        ``control="position"``: float32 ``(3,)``, the change dX, dY, dTheta of the commanded cart pose in one step,
        at most 40 mm, 40 mm, 100 mrad (0.8 m/s, 0.8 m/s, 2 rad/s). ``control="acceleration"``: float32 ``(3,)``, the
        acceleration of the cart, at most 6 m/s^2, 6 m/s^2, 20 rad/s^2. In both cases the cart stays within its limits
        of speed and acceleration and brakes at the edge of the workspace, to within 2 mm and 7 mrad. Actions are in SI units and mean the
        same in datasets, in TorchRL and here. ``gymnasium.wrappers.RescaleAction`` scales them to -1 to 1, for
        learners that explore with noise of size 1.

    Observation:
        ``state``: float32 ``(16,)`` in task 1 and ``(20,)`` in tasks 2 and 3, privileged, for experts (see the classes
        of the tasks).
        ``pixels``: uint8 ``(64, 64, 3)``.
        ``pixels_agent_pos``: dict of ``pixels`` and ``agent_pos``, float32 ``(5,)``: commanded cart pose x, y, theta
        and goal x, y (m, m, rad, m, m).

    Goal:
        Tasks 1 and 2: target of the cart's centre, a green square. Task 3: middle of the green bin's opening.

    Reward:
        About -1 to 1 a step; the classes of the tasks have the formulas. Task 1: grows with a smaller goal distance,
        -20 once the block is dropped. Task 2: grows with a shorter way around the obstacle, -20 once the block is
        dropped or the obstacle touched. Task 3: 1 with the block in the bin, up to 0.2 for a block near it, -5 once the
        block missed the bin or the cart touched it.

    Success:
        Tasks 1 and 2, true in the last step only: the block was never dropped, the position error is under 50 mm, and
        in task 2 nothing touched the obstacle. Task 3, true in each step in which it holds: the block rests in the
        bin, and the cart never touched the bin.

    Info:
        ``is_success``, ``dropped``, ``touched`` and ``position_error``. ``dropped``: the block was
        ever not carried, that is, it leaned over by more than 45 degrees relative to the cart, its centre was below
        half its standing height, or it was beyond the cart's edge. ``touched``: cart or block ever touched the
        obstacle or the bin. ``position_error``: mean distance (m) of cart and goal in the last 10 steps.

    Starting state:
        Sizes, positions and colours are drawn from ``ranges`` by the seed. The block is upright and at rest on a
        level, resting cart.

    Termination:
        The episode terminates when it has failed for good. Task 1: the block is dropped. Task 2: the block is dropped
        or the obstacle touched. Task 3: the block fell below the bin's floor beside it, or the cart touched the bin.
        The episode is truncated after 120 steps.

    Args:
        task: name of the task, or ``"module:Class"`` of your own (see :class:`dynmap_rl.envs.Task`).
        obs_type: ``state``, ``pixels`` or ``pixels_agent_pos``.
        control: ``position`` or ``acceleration``.
        ranges: ranges from which scenes are drawn; by default the task's own.
        render_mode: ``rgb_array``, ``human`` (a window that shows every step in real time), or None.
        render_size: side of the picture that ``render()`` returns or shows, in pixels.

    Raises:
        ValueError: an argument is not valid.

    Reset arguments:
        ``seed`` determines the scene. ``options`` fixes any of its factors (see :class:`dynmap_rl.envs.Scene`):
        ``reset(options={"cart_x": 0.3, "block_color": (0, 0, 90)})``.

    Version history:
        v1: the cart's limits are twice those of v0, above the acceleration at which blocks tip, so that the limits
        alone no longer keep the block up. A failure costs 20 (task 3: 5).
        v0: first release, no longer available.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": int(1 / CONTROL_DT)}

    def __init__(
        self,
        task: str = "balance_reaching",
        obs_type: str = "state",
        control: str = "position",
        ranges: SceneRanges | None = None,
        render_mode: str | None = None,
        render_size: int = 256,
    ):
        if obs_type not in OBS_TYPES:
            raise ValueError(f"obs_type must be one of {OBS_TYPES}, got {obs_type!r}")
        if control not in ACTION_LIMITS:
            raise ValueError(f"control must be one of {sorted(ACTION_LIMITS)}, got {control!r}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be human, rgb_array or None, got {render_mode!r}")
        if render_size < 1:
            raise ValueError(f"render_size must be at least 1 pixel, got {render_size}")
        self.task = get_task(task, kind=Task)
        self.task_description = self.task.description
        self.obs_type = obs_type
        self.control = control
        self.ranges = choose_ranges(self.task.ranges, ranges)
        self.render_mode = render_mode
        self._render_size = render_size
        self._max_episode_steps = EPISODE_STEPS
        self._frames = Renderer(64) if obs_type != "state" else None
        self._large: Renderer | None = None
        self._window: Window | None = None
        self.world: World | None = None
        limit = ACTION_LIMITS[control].astype(np.float32)
        self.action_space = spaces.Box(-limit, limit, dtype=np.float32)
        self.observation_space = self._observation_space()

    def _observation_space(self) -> spaces.Space:
        pixels = spaces.Box(0, 255, (64, 64, 3), np.uint8)
        agent_pos = spaces.Box(-2.0, 2.0, (5,), np.float32)
        state = spaces.Box(-10.0, 10.0, (self.task.state_size,), np.float32)
        both = spaces.Dict({"pixels": pixels, "agent_pos": agent_pos})
        return {"state": state, "pixels": pixels, "pixels_agent_pos": both}[self.obs_type]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        scene = self.task.sample_scene(self.np_random, self.ranges)
        self.world = self.task.make_world(scene.replace(**(options or {})))
        self._show()
        return self._observe(), self._info()

    def step(self, action: np.ndarray):
        if self.world is None:
            raise gym.error.ResetNeeded("the environment has not begun; call reset first")
        if self.control == "position":
            self.world.step(action)
        else:
            self.world.accelerate(action)
        self._show()
        world = self.world
        truncated = world.steps >= EPISODE_STEPS
        return self._observe(), self.task.reward(world), self.task.is_over(world), truncated, self._info()

    def render(self) -> np.ndarray | None:
        """uint8 ``[render_size, render_size, 3]``; None for ``human``, which is shown without being asked."""
        return self._draw() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def _draw(self) -> np.ndarray:
        if self.world is None:
            raise gym.error.ResetNeeded("the environment has not begun; call reset first")
        self._large = self._large or Renderer(self._render_size)
        return self._large.draw(self.world, self.task)

    def _show(self) -> None:
        if self.render_mode == "human":
            self._window = self._window or Window(self._render_size, self.metadata["render_fps"])
            self._window.show(self._draw())

    def _observe(self):
        if self.obs_type == "state":
            return self.task.state(self.world)
        pixels = self._frames.draw(self.world, self.task)
        if self.obs_type == "pixels":
            return pixels
        return {"pixels": pixels, "agent_pos": self.task.agent_pos(self.world).astype(np.float32)}

    def _info(self) -> dict[str, bool | np.float32]:
        return {
            "is_success": bool(self.task.is_success(self.world)),
            "dropped": bool(self.world.dropped),
            "touched": bool(self.world.touched),
            "position_error": np.float32(self.world.position_error),
        }
