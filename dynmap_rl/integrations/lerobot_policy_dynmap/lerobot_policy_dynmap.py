"""Plugin: LeRobot imports installed distributions named ``lerobot_policy_*``, and this one registers ``dynmap``."""

import dynmap_rl.integrations.lerobot  # noqa: F401
