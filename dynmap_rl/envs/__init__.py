"""Worlds, tasks and their adapters: Gymnasium ids, one batched TorchRL environment, and the world model in TorchRL."""

import importlib

from .scene import Scene, SceneRanges, sample_scene, scene_seed
from .world import World

_MODULES = {
    "BalanceReaching": "tasks",
    "DynmapBatchedEnv": "torchrl_env",
    "DynmapEnv": "gym_env",
    "ImaginationEnv": "imagination",
    "WorldModelTransform": "world_model_transform",
    "get_task": "tasks",
    "make_start": "imagination",
}
__all__ = [*_MODULES, "Scene", "SceneRanges", "World", "sample_scene", "scene_seed"]


def __getattr__(name: str):
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
