"""Worlds, tasks and their adapters: Gymnasium ids and one batched TorchRL environment."""

from .scene import Scene, SceneRanges, sample_scene, scene_seed
from .world import World

__all__ = ["DynmapBatchedEnv", "DynmapEnv", "Scene", "SceneRanges", "World", "sample_scene", "scene_seed"]


def __getattr__(name: str):
    if name == "DynmapBatchedEnv":
        from .torchrl_env import DynmapBatchedEnv

        return DynmapBatchedEnv
    if name == "DynmapEnv":
        from .gymnasium_env import DynmapEnv

        return DynmapEnv
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
