"""Demonstrations: recorded as LeRobot datasets, loaded as one TensorDict, cut into augmented windows."""

from .augmentation import add_distractors, augment
from .demonstrations import load_dataset, load_meta
from .derive import add_dynamics, differentiate
from .features import compute_features
from .format.hub import push_dataset
from .recording.shards import normalization_constants, record_dataset
from .replay import as_replay_buffer
from .robot import load_foreign
from .windows import sample_windows

__all__ = [
    "add_distractors",
    "add_dynamics",
    "as_replay_buffer",
    "augment",
    "compute_features",
    "differentiate",
    "load_dataset",
    "load_foreign",
    "load_meta",
    "normalization_constants",
    "push_dataset",
    "record_dataset",
    "sample_windows",
]
