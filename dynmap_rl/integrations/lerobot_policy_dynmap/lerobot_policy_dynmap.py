"""LeRobot imports every installed distribution whose name begins with ``lerobot_policy_``: this registers ours."""

import dynmap_rl.integrations.lerobot  # noqa: F401
