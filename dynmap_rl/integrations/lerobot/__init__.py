"""LeRobot's commands on the environments, datasets and models of this package.

Importing it registers the environment ``dynmap``, the policy ``dynmap`` and the robot ``dynmap``. LeRobot does so by
``--policy.discover_packages_path=dynmap_rl.integrations.lerobot``, or without an option where the distribution in
``dynmap_rl/integrations/lerobot_policy_dynmap`` or ``lerobot_env_dynmap`` beside it is installed.
"""

from .actor import LeRobotActor
from .configuration_dynmap import DynmapConfig
from .environment import DynmapEnvConfig
from .export import export_to_lerobot, import_from_lerobot
from .robot import DynmapRobot, DynmapRobotConfig

__all__ = [
    "DynmapConfig",
    "DynmapEnvConfig",
    "DynmapRobot",
    "DynmapRobotConfig",
    "LeRobotActor",
    "export_to_lerobot",
    "import_from_lerobot",
]
