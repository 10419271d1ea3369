"""The tasks as the LeRobot environment ``dynmap``."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from functools import partial

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.processor import PolicyProcessorPipeline, RenameObservationsProcessorStep
from lerobot.utils.constants import ACTION, OBS_IMAGE, OBS_STATE

from dynmap_rl.envs.delay import DelayFrames, FrameDelay
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.keys import CAMERA, CAMERAS, GYMNASIUM_IDS, GYMNASIUM_TASK


@EnvConfig.register_subclass("dynmap")
@dataclass
class DynmapEnvConfig(EnvConfig):
    """Settings of ``--env.type=dynmap``; observations have the names of the datasets' columns.

    Attributes:
        task: ``balance_reaching``, ``balance_reaching_obstacle``, ``bin_dropping``, a MuJoCo task such as
            ``mujoco:PlateSlide``, or ``module:Class`` of your own.
        fps: control steps per second, by definition of the task.
        episode_length: control steps, by definition of the task.
        split: split of the scenes. ``--seed`` counts within the split, so that no evaluation uses scenes of the
            demonstrations: ``test`` with 0 to 999 are the start states of the tables, ``validation`` is for choosing
            settings.
        render_size: side of the frames of a video, in pixels; an even number.
        delay: delay of the frames, in control steps (see :class:`dynmap_rl.envs.FrameDelay`, also for the next two).
        jitter: largest deviation from it.
        lost: probability that a frame is lost.

    Raises:
        ValueError: task or split is unknown, length or rate differ, the size is odd, or delays are impossible.
    """

    task: str | None = "balance_reaching"
    fps: int | None = None
    episode_length: int | None = None
    split: str = "test"
    render_size: int = 256
    delay: int = 0
    jitter: int = 0
    lost: float = 0.0

    def __post_init__(self):
        if (here := os.getcwd()) not in sys.path:  # LeRobot's commands do not look here for module:Class
            sys.path.append(here)
        if self.task is None:
            raise ValueError("--env.task must be the name of a task, got None")
        if self.render_size < 2 or self.render_size % 2:
            raise ValueError(f"--env.render_size must be an even number of pixels, got {self.render_size}")
        layout = get_task(self.task).layout
        scene_seed(self.split, 0)
        FrameDelay(self.delay, self.jitter, self.lost)
        given = self.fps or layout.fps, self.episode_length or layout.steps
        if given != (layout.fps, layout.steps):
            raise ValueError(
                f"--env.fps and --env.episode_length of {self.task} must be {layout.fps} and {layout.steps}, got "
                f"{given[0]} and {given[1]}"
            )
        self.fps, self.episode_length = given
        side = layout.image_size
        frames = {name: f"{CAMERAS}{camera}" for name, camera in self._frames.items()}
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (len(layout.action),)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (len(layout.state),)),
            **{name: PolicyFeature(FeatureType.VISUAL, (side, side, 3)) for name in frames},
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, **frames}

    @property
    def _frames(self) -> dict[str, str]:
        """Cameras by the names that LeRobot gives the frames of an environment."""
        cameras = get_task(self.task).layout.cameras
        return {"pixels": cameras[0]} if self._flat else {f"pixels/{camera}": camera for camera in cameras}

    @property
    def _flat(self) -> bool:
        """Whether the task has a Gymnasium id of its own, whose frames are no dict."""
        return self.task in GYMNASIUM_IDS

    @property
    def package_name(self) -> str:
        """Package that registers the Gymnasium ids."""
        return "dynmap_rl"

    @property
    def gym_id(self) -> str:
        """Gymnasium id of the task."""
        return GYMNASIUM_IDS.get(self.task, GYMNASIUM_TASK)

    @property
    def gym_kwargs(self) -> dict:
        """Arguments of the Gymnasium environment."""
        own = {"obs_type": "pixels_agent_pos"} if self._flat else {"task": self.task}
        return {"render_mode": "rgb_array", "render_size": self.render_size, **own}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Make one vector environment of ``n_envs`` scenes, as ``{suite: {number: environments}}``."""
        delay = FrameDelay(self.delay, self.jitter, self.lost)
        makers = [partial(make_env, self.gym_id, self.gym_kwargs, self.split, delay)] * n_envs
        if use_async_envs and n_envs > 1:
            envs = AsyncVectorEnv(makers, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP)
        else:
            envs = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: envs}}

    def get_env_processors(self):
        """Return the processors that rename the frames' column."""
        # LeRobot calls the frames of an environment with one camera observation.image.
        rename = RenameObservationsProcessorStep({OBS_IMAGE: CAMERA})
        return PolicyProcessorPipeline(steps=[rename]), PolicyProcessorPipeline(steps=[])


class _ForLeRobot(gym.Wrapper):
    """Adapter of resets to LeRobot.

    Seeds count within a split. The mark of a new rollout that LeRobot adds to the options of a reset is removed, since
    options are factors of a scene of cart and block.
    """

    def __init__(self, env: gym.Env, split: str):
        super().__init__(env)
        self.split = split

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        seed = None if seed is None else scene_seed(self.split, seed)
        options = {name: value for name, value in (options or {}).items() if name != NEW_ROLLOUT_OPTION}
        return self.env.reset(seed=seed, options=options)


def make_env(gym_id: str, arguments: dict, split: str, delay: FrameDelay | None = None) -> gym.Env:
    """Make a Gymnasium environment whose seeds are as LeRobot needs them."""
    env = gym.make(gym_id, disable_env_checker=True, **arguments)
    return _ForLeRobot(env if delay in (None, FrameDelay()) else DelayFrames(env, delay), split)
