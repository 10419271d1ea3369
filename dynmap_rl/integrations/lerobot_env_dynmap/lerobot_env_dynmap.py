"""Plugin: LeRobot imports installed distributions named ``lerobot_env_*``, and this one registers ``dynmap``."""

import dynmap_rl.integrations.lerobot.environment  # noqa: F401
