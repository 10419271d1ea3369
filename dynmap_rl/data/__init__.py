"""Demonstrations: recorded as LeRobot datasets, loaded as one TensorDict, cut into augmented windows."""

import importlib

_MODULES = {
    "add_distractors": "augmentation",
    "augment": "augmentation",
    "compute_features": "features",
    "find_dataset": "loading",
    "load_dataset": "loading",
    "load_meta": "loading",
    "normalization_constants": "recording",
    "push_dataset": "writing",
    "record_dataset": "recording",
    "sample_windows": "augmentation",
}
__all__ = list(_MODULES)


def __getattr__(name: str):
    if name in _MODULES:
        return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
