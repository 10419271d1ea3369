"""Demonstrations: recorded as LeRobot datasets, loaded as one TensorDict, cut into augmented windows."""

import importlib

_MODULES = {
    "META": "loading",
    "add_distractors": "augmentation",
    "as_replay_buffer": "replay",
    "add_dynamics": "dynamics",
    "augment": "augmentation",
    "compute_features": "features",
    "describe_foreign": "foreign",
    "differentiate": "dynamics",
    "find_dataset": "reading",
    "keep_episode": "human",
    "load_dataset": "loading",
    "load_foreign": "foreign",
    "load_meta": "loading",
    "normalization_constants": "recording",
    "parse_entries": "dynamics",
    "publish_episodes": "human",
    "push_dataset": "hub",
    "range_constants": "foreign",
    "record_dataset": "recording",
    "sample_windows": "augmentation",
}
__all__ = list(_MODULES)


def __getattr__(name: str):
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
