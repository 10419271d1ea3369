"""Dynamics Mapping: world models for visual imitation learning, supervised on the dynamics of the scene.

Importing the package registers the Gymnasium ids; its parts (``envs``, ``modules``, ``objectives``, ``data``, ``experts``,
``evaluation``) are imported when first used.
"""

import importlib

import gymnasium

__version__ = "0.1.0"
__all__ = ["data", "envs", "evaluation", "experts", "modules", "objectives"]


def __getattr__(name: str):
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "GYMNASIUM_IDS", "__version__"]


GYMNASIUM_IDS = {
    "dynmap_rl/BalanceReaching-v0": "balance_reaching",
    "dynmap_rl/BalanceReachingObstacle-v0": "balance_reaching_obstacle",
    "dynmap_rl/BinDropping-v0": "bin_dropping",
}
for _id, _task in GYMNASIUM_IDS.items():
    gymnasium.register(_id, "dynmap_rl.envs.gymnasium_env:DynmapEnv", kwargs={"task": _task})
