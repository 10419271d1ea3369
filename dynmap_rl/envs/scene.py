"""Scenes, the ranges from which they are drawn, and their seeds (paper, Sec. IV-B)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, ClassVar

import numpy as np

Point = tuple[float, float]
Range = tuple[float, float]
Color = tuple[int, int, int]

GOAL_COLOR: Color = (0, 200, 0)
SIZES = ("_width", "_height", "_length", "_depth", "density")
SPLITS = {"train": 0, "eval": 1, "validation": 2, "test": 3, "exploration": 4}
SEEDS_PER_SPLIT = 100_000_000


@dataclass(frozen=True)
class Scene:
    """Start of an episode: sizes and positions (m), colours (0..255), density (kg/m^2).

    ``cart_x, cart_y`` is the cart's centre, ``block_shift`` the block's offset from it along the cart.

    Raises:
        ValueError: a number is not finite, a size or the density not positive, the friction negative, a place not in the
            picture, a colour not three whole numbers of 0..255, or the block's centre beside the cart.
    """

    cart_width: float = 0.25
    cart_height: float = 0.04
    block_width: float = 0.06
    block_height: float = 0.16
    block_shift: float = 0.0
    cart_x: float = 0.3
    cart_y: float = 0.2
    goal_x: float = 0.7
    goal_y: float = 0.4
    friction: float = 0.8
    density: float = 100.0
    cart_color: Color = (150, 40, 40)
    block_color: Color = (40, 40, 150)
    background_color: Color = (230, 230, 230)

    def __post_init__(self):
        for name, value in vars(self).items():
            if name.endswith("_color"):
                _check_color(name, value)
                continue
            if not isinstance(value, Real) or not math.isfinite(value):
                raise ValueError(f"{name} of the scene must be a finite number, got {value!r}")
            object.__setattr__(self, name, float(value))
            if name == "friction" and value < 0:
                raise ValueError(f"friction of the scene must be at least 0, got {value}")
            if name.endswith(SIZES) and not value > 0:
                raise ValueError(f"{name} of the scene must be positive, got {value}")
            if name.endswith(("_x", "_y")) and not 0 <= value <= 1:
                raise ValueError(f"{name} of the scene must be 0 to 1 m, got {value}")
        if 2 * abs(self.block_shift) > self.cart_width:
            half = self.cart_width / 2
            raise ValueError(
                f"block_shift must be within +-{half}, half the cart's width, got {self.block_shift}"
            )

    def to_dict(self) -> dict:
        """Return all factors by their names, for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping) -> Scene:
        """Make a scene from factors by their names; the others have their defaults.

        Raises:
            ValueError: a factor is unknown or impossible.
        """
        return cls().replace(**values)

    def replace(self, **values) -> Scene:
        """Return a copy with some factors replaced.

        Raises:
            ValueError: a factor is unknown or impossible.
        """
        unknown = set(values) - {f.name for f in fields(self)}
        if unknown:
            known = [f.name for f in fields(self)]
            raise ValueError(f"factors of the scene must be among {known}, got {sorted(unknown)}")
        return replace(self, **{name: _plain(value) for name, value in values.items()})


def _plain(value):
    """Return numbers of NumPy as those of Python, and sequences as tuples, for JSON and comparison."""
    if isinstance(value, np.ndarray | list | tuple):
        return tuple(_plain(entry) for entry in value)
    return value.item() if isinstance(value, np.generic) else value


def _check_color(name: str, value: Color) -> None:
    whole = isinstance(value, Sequence) and all(isinstance(channel, Integral) for channel in value)
    if not whole or len(value) != 3 or not all(0 <= channel <= 255 for channel in value):
        raise ValueError(f"{name} of the scene must be three whole numbers of 0..255, got {value!r}")


@dataclass(frozen=True)
class ObstacleScene(Scene):
    """Scene of task 2: a vertical obstacle, given by its middle and its length."""

    obstacle_x: float = 0.5
    obstacle_y: float = 0.38
    obstacle_length: float = 0.22

    def __post_init__(self):
        super().__post_init__()
        if self.obstacle_length < 0.02:
            raise ValueError(
                f"obstacle_length of the scene must be at least 0.02 m, its width, got {self.obstacle_length}"
            )


@dataclass(frozen=True)
class BinScene(Scene):
    """Scene of task 3: a bin with its inner width and depth; the middle of its opening is the goal."""

    goal_y: float = 0.2
    bin_width: float = 0.28
    bin_depth: float = 0.12


@dataclass(frozen=True)
class SceneRanges:
    """Uniform ranges from which a scene is drawn (units as in :class:`Scene`).

    Start and goal are at least ``min_distance`` (m) apart, so that no episode starts as a success. By default objects
    are darker than the background. The colours of cart and block differ by at least ``min_contrast`` (Euclidean
    distance, 0..441), so that both are visible.

    Attributes:
        scene: class of the scenes that are drawn. A subclass with more factors has a range for each.

    Raises:
        ValueError: a range is not two finite numbers, the lower one first, holds impossible factors of a scene, or a least
            distance or contrast is not a number of at least 0.
    """

    cart_width: Range = (0.20, 0.30)
    cart_height: Range = (0.04, 0.04)
    block_width: Range = (0.06, 0.06)
    block_height: Range = (0.12, 0.20)
    block_shift: Range = (-0.04, 0.04)
    cart_x: Range = (0.18, 0.82)
    cart_y: Range = (0.08, 0.68)
    goal_x: Range = (0.18, 0.82)
    goal_y: Range = (0.08, 0.68)
    friction: Range = (0.8, 0.8)
    density: Range = (100.0, 100.0)
    object_color: Range = (0, 140)
    background_color: Range = (180, 255)
    min_distance: float = 0.2
    min_contrast: float = 60.0

    scene: ClassVar[type[Scene]] = Scene

    def __post_init__(self):
        for name, value in vars(self).items():
            if name.startswith("min_"):
                if not 0 <= value < math.inf:
                    raise ValueError(f"{name} of the ranges must be a number of at least 0, got {value!r}")
                continue
            if np.shape(value) != (2,) or not np.isfinite(value).all() or value[0] > value[1]:
                raise ValueError(
                    f"{name} of the ranges must be two finite numbers, the lower one first, got {value!r}"
                )
        low, high = self._end(0), self._end(1)
        for factors in (low, high, low | {"block_shift": max(self.block_shift, key=abs)}):
            self.scene(**factors)  # which raises where a factor is impossible

    def _end(self, end: int) -> dict:
        """Return the factors at the lower (0) or upper (1) ends of the ranges."""
        names = {f.name for f in fields(self.scene)} & {f.name for f in fields(self)} - {"background_color"}
        object_color, background = ((int(r[end]),) * 3 for r in (self.object_color, self.background_color))
        colors = {"cart_color": object_color, "background_color": background}
        return {name: getattr(self, name)[end] for name in names} | colors


@dataclass(frozen=True)
class ObstacleRanges(SceneRanges):
    """Ranges of task 2: the obstacle stands in the centre of starts and goals.

    With the expert's margin of 30 mm there is no way under it.
    """

    obstacle_x: Range = (0.5, 0.5)
    obstacle_y: Range = (0.38, 0.38)
    obstacle_length: Range = (0.22, 0.22)

    scene: ClassVar[type[Scene]] = ObstacleScene


@dataclass(frozen=True)
class BinRanges(SceneRanges):
    """Ranges of task 3: the cart starts above the bin's opening."""

    cart_y: Range = (0.45, 0.68)
    goal_x: Range = (0.2, 0.8)
    goal_y: Range = (0.14, 0.26)
    bin_width: Range = (0.24, 0.32)
    bin_depth: Range = (0.10, 0.13)

    scene: ClassVar[type[Scene]] = BinScene


def sample_scene(rng: np.random.Generator, ranges: SceneRanges | None = None) -> Scene:
    """Draw a scene; the same state of the generator gives the same scene.

    Raises:
        ValueError: 1,000 draws held no start far enough from the goal, or no colours different enough.
    """
    r = ranges or SceneRanges()
    for _ in range(1000):
        factors = {
            f.name: float(rng.uniform(*getattr(r, f.name)))
            for f in fields(r.scene)
            if not f.name.endswith("color")
        }
        distance = np.hypot(factors["cart_x"] - factors["goal_x"], factors["cart_y"] - factors["goal_y"])
        if distance >= r.min_distance:
            break
    else:
        raise ValueError(f"the ranges must hold a start {r.min_distance} m from a goal; widen them")
    return r.scene(**factors, **_sample_colors(rng, r))


def _sample_colors(rng: np.random.Generator, r: SceneRanges) -> dict[str, Color]:
    def color(low, high):
        return tuple(int(c) for c in rng.integers(int(low), int(high) + 1, 3))

    background = color(*r.background_color)
    for _ in range(1000):
        cart, block = color(*r.object_color), color(*r.object_color)
        if np.linalg.norm(np.subtract(cart, block)) >= r.min_contrast:
            return {"cart_color": cart, "block_color": block, "background_color": background}
    raise ValueError(f"object_color must hold colours that differ by {r.min_contrast}; lower min_contrast")


def scene_seed(split: str, index: int) -> int:
    """Return the seed of scene ``index`` of a split. Splits never share a seed.

    Raises:
        ValueError: the split is unknown, or the index is not in 0..99,999,999.
    """
    if split not in SPLITS:
        raise ValueError(f"the split must be one of {sorted(SPLITS)}, got {split!r}")
    if not 0 <= index < SEEDS_PER_SPLIT:
        raise ValueError(f"the scene index must be in 0..{SEEDS_PER_SPLIT - 1}, got {index}")
    return SPLITS[split] * SEEDS_PER_SPLIT + index


def scene_seeds(split: str, count: int, start: int = 0) -> list[int]:
    """Return the seeds of the scenes ``start`` to ``start + count - 1`` of a split."""
    return [scene_seed(split, start + i) for i in range(count)]


def choose_ranges(own: Any, ranges: Any) -> Any:
    """Return ``ranges``, or a task's ``own`` ones for None.

    Raises:
        ValueError: ``ranges`` are of another type, their scenes lack factors of the task, or the task has no ranges.
    """
    if ranges is None:
        return own
    if own is None:
        raise ValueError("ranges have no effect in a task without ranges; leave them out")
    fits = isinstance(ranges, SceneRanges if isinstance(own, SceneRanges) else type(own))
    if not fits or (isinstance(own, SceneRanges) and not issubclass(ranges.scene, own.scene)):
        raise ValueError(f"ranges must be {type(own).__name__} in this task, got {type(ranges).__name__}")
    return ranges
