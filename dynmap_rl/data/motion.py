"""What a source of dynamics measures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .tracking import Tracks


@dataclass(frozen=True)
class Motion:
    """What a source measures in an episode of T steps.

    Attributes:
        position: ``[T, D]``, float64.
        angles: entries that are angles.
        period: period of the angles: 2 pi for radians, 360 for degrees.
        velocity: ``[T, D]`` per s, where the source measures it itself; None is to be derived.
        other: a second measurement of the velocity ``[T, D]`` that was not used, for comparison, or None.
        found: bool ``[T, N]``, whether each object was found in the frame; None for a state.
        tracks: the objects, for the sources that segment them.
    """

    position: np.ndarray
    angles: list[int]
    period: float = 2 * np.pi
    velocity: np.ndarray | None = None
    other: np.ndarray | None = None
    found: np.ndarray | None = None
    tracks: Tracks | None = None

    def light(self) -> Motion:
        """Return the same without the masks, which are as large as the frames."""
        return replace(self, tracks=replace(self.tracks, labels=None)) if self.tracks else self
