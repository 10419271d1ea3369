"""LeRobot's policy server, which also serves the policy ``dynmap``.

    python -m dynmap_rl.integrations.lerobot.policy_server --host=127.0.0.1 --port=8080 --fps=20

Options are those of ``lerobot.async_inference.policy_server``, which accepts only policies that are named in a list.
"""

from .configuration_dynmap import DynmapConfig

if __name__ == "__main__":
    # Here, since LeRobot's discovery imports every module of this package, and these need the extra async.
    from lerobot.async_inference.constants import SUPPORTED_POLICIES
    from lerobot.async_inference.policy_server import serve

    if (name := DynmapConfig.get_choice_name(DynmapConfig)) not in SUPPORTED_POLICIES:
        SUPPORTED_POLICIES.append(name)
    serve()
