"""The tasks as Gymnasium environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from .renderer import Renderer, Window
from .scene import SceneRanges, choose_ranges
from .tasks import get_task
from .world import ACCELERATION_LIMIT, CONTROL_DT, EPISODE_STEPS, VELOCITY_LIMIT

ACTION_LIMITS = {"position": VELOCITY_LIMIT * CONTROL_DT, "acceleration": ACCELERATION_LIMIT}
OBS_TYPES = ("state", "pixels", "pixels_agent_pos")


class DynmapEnv(gym.Env):
    """A cart carries a free-standing block over a 1 m x 1 m scene, controlled at 20 Hz.

    Description:
        The block stands on the cart, held by nothing but friction. It tips when the cart accelerates faster than
        about ``9.81 * block_width / block_height`` (2.9 to 4.9 m/s^2 here). Every episode has its own sizes,
        positions and colours. An episode lasts 120 steps (6 s).

    Action:
        ``control="position"``: float32 ``(3,)``, the change dX, dY, dTheta of the commanded cart pose in one step,
        at most 20 mm, 20 mm, 50 mrad (0.4 m/s, 1 rad/s). ``control="acceleration"``: float32 ``(3,)``, the cart's
        acceleration, at most 3 m/s^2, 3 m/s^2, 10 rad/s^2. Both go through the same limits of speed, acceleration
        and room to brake before the edge of the workspace. Both are SI units, so that actions mean the same in
        datasets, in TorchRL and here; ``gymnasium.wrappers.RescaleAction`` makes them -1 to 1, which learners that
        explore with noise of size 1 need.

    Observation:
        ``state``: float32 ``(16,)`` or, in tasks 2 and 3, ``(20,)``, privileged, for experts (see ``state``
        of each task in ``dynmap_rl.envs.tasks``).
        ``pixels``: uint8 ``(64, 64, 3)``.
        ``pixels_agent_pos``: a dict of ``pixels`` and ``agent_pos``, float32 ``(5,)``: commanded cart pose x, y,
        theta and goal x, y (m, m, rad, m, m).

    Goal:
        Task 1, ``balance_reaching``, and task 2, ``balance_reaching_obstacle``: where the cart's centre shall be, a
        green square. Task 3, ``bin_dropping``: the middle of the green bin's opening.

    Reward:
        About -1 to 1 a step (see ``reward`` of each task). Task 1: by the goal distance. Task 2: by the length of
        the way around the obstacle, -1 for a drop or a touch. Task 3: 1 with the block in the bin, -1 once it
        missed or the cart touched the bin, and up to 0.2 for a block that is near.

    Success, drop, touch, position error:
        ``info`` holds ``is_success``, ``dropped``, ``touched`` (cart or block touched obstacle or bin) and
        ``position_error`` (m, the mean distance of cart and goal in the last 10 steps), as numpy scalars.
        Dropped: the block leans over by more than 45 degrees relative to the cart, its centre is below half its
        standing height, or it is beyond the cart's edge; a drop is never taken back. Success of task 1, on the last
        step only: never dropped, and a position error under 50 mm. Of task 2: the obstacle is also untouched. Of
        task 3, in every step of which it is true: the block rests in the bin, which the cart never touched.

    Starting state:
        Drawn from ``ranges`` by the seed; block upright and at rest on a level, resting cart.

    Termination, truncation:
        Terminated when the episode has failed for good (task 1: dropped; task 2: dropped or obstacle touched; task 3:
        the block fell below the bin's floor beside it, or the cart touched the bin), truncated after 120 steps.

    Args:
        task: name of the task, or ``"module:Class"`` of your own.
        obs_type: ``state``, ``pixels`` or ``pixels_agent_pos``.
        control: ``position`` or ``acceleration``.
        ranges: what scenes are drawn from; by default the task's own.
        render_mode: ``rgb_array``, ``human`` (a window that shows every step in real time), or None.
        render_size: side of what ``render()`` returns or shows, in pixels.

    Reset arguments:
        ``reset(options={"cart_x": 0.3, "block_color": (0, 0, 90), ...})`` fixes any factor of the scene.

    Version history:
        v0: first release.
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
            raise ValueError(f"unknown obs_type {obs_type!r}; choose from {OBS_TYPES}")
        if control not in ACTION_LIMITS:
            raise ValueError(f"unknown control {control!r}; choose from {sorted(ACTION_LIMITS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; choose human, rgb_array or None")
        self.task = get_task(task)
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
        return {"pixels": pixels, "agent_pos": agent_pos(self.world, self.task)}

    def _info(self) -> dict[str, np.generic]:
        return {
            "is_success": np.bool_(self.task.is_success(self.world)),
            "dropped": np.bool_(self.world.dropped),
            "touched": np.bool_(self.world.touched),
            "position_error": np.float32(self.world.position_error),
        }


def agent_pos(world, task) -> np.ndarray:
    """What a policy may know beside the frame, float32 ``[5]``: commanded cart pose and goal."""
    return np.concatenate([world.commanded, task.goal(world)]).astype(np.float32)
