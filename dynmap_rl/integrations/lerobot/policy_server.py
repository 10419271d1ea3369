"""LeRobot's policy server, which also serves the policy ``dynmap``.

    python -m dynmap_rl.integrations.lerobot.policy_server --host=127.0.0.1 --port=8080 --fps=20

Options are those of ``lerobot.async_inference.policy_server``, which accepts only policies that are named in a list.
"""

from lerobot.async_inference.constants import SUPPORTED_POLICIES
from lerobot.async_inference.policy_server import serve

from .configuration_dynmap import DynmapConfig

if (name := DynmapConfig.get_choice_name(DynmapConfig)) not in SUPPORTED_POLICIES:
    SUPPORTED_POLICIES.append(name)

if __name__ == "__main__":
    serve()
