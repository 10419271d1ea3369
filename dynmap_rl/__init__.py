"""Dynamics Mapping: world models for visual imitation learning, supervised on the dynamics of the scene."""

import gymnasium

from .keys import GYMNASIUM_IDS, GYMNASIUM_TASK

__version__ = "0.2.0"

for _task, _id in GYMNASIUM_IDS.items():
    gymnasium.register(_id, "dynmap_rl.envs.gym_env:DynmapEnv", kwargs={"task": _task})
gymnasium.register(GYMNASIUM_TASK, "dynmap_rl.envs.task_env:TaskEnv")
