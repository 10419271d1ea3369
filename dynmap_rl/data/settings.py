"""Typed settings of the data. A comment above a field is the help text of its option."""

from __future__ import annotations

from dataclasses import dataclass

from dynmap_rl.utils.settings import check_at_least


@dataclass(frozen=True)
class Augmentation:
    """Random changes of training windows (see :func:`dynmap_rl.data.augment`); recipes change tasks in the plane alone."""

    # Permute the colour channels of each window.
    recolor: bool = True
    # Mirror half of the windows left to right (joint and end to end: where the task is symmetric).
    mirror: bool = True
    # Largest shift of a window, in pixels (joint and end to end: where the task is symmetric).
    max_shift: int = 6

    def __post_init__(self):
        check_at_least(self, 0, "max_shift")

    @classmethod
    def off(cls) -> Augmentation:
        """Return the settings without any change."""
        return cls(recolor=False, mirror=False, max_shift=0)
