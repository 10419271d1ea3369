"""Datasets that are of no task of ours: any LeRobot v3.0 dataset, say a robot's, as pieces of equal length.

Their frames are resized, their episodes cut and held out, and their numbers normalised by rules that know nothing of
scene, cart or goal. There is no simulator to try a policy in, and no symmetry to augment by.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from .demonstrations import FRAME_SHAPE
from .derive import entry_names, parse_entries
from .format.frames import choose_camera, iterate_frames
from .format.reading import find_dataset, read_column, read_info, read_split, read_table, spans
from dynmap_rl.keys import DYNAMICS

LONGEST = 120  # steps of a piece: longer ones make batches of whole pieces slow


def describe_foreign(
    dataset: str | Path, camera: str | None = None, goal: str | None = None, supervision: tuple[str, ...] = ()
) -> dict:
    """What would be loaded of a dataset, checked before any frame is.

    Args:
        camera: its column; by default the first.
        goal: ``COLUMN:ENTRIES``, such as ``observation.state:3,4``; by default there is none.
        supervision: quantities whose columns must be there.

    Returns:
        ``root``, ``info`` (of ``meta/info.json``), ``camera``, ``goal`` (column and entries, or None), and
        ``names``: those of the entries of ``action`` and of every ``dynamics`` quantity that is there.

    Raises:
        ValueError: there is no such dataset, or it lacks something.
    """
    root = find_dataset(dataset)
    info = read_info(root)
    features = info["features"]
    if "action" not in features:
        raise ValueError(f"{root} has no column 'action'; only demonstrations can be imitated")
    if missing := [f"dynamics.{q}" for q in supervision if f"dynamics.{q}" not in features]:
        raise ValueError(
            f"{root} has no {', '.join(missing)}; give it dynamics with recipes/add_dynamics.py, or train with "
            "--supervision none"
        )
    columns = {"action": "action"} | {q: f"dynamics.{q}" for q in DYNAMICS if f"dynamics.{q}" in features}
    return {
        "root": root,
        "info": info,
        "camera": choose_camera(root, info, camera),
        "goal": _check_goal(root, info, goal),
        "names": {key: entry_names(info, column) for key, column in columns.items()},
    }


def load_foreign(
    dataset: str | Path, min_steps: int, camera: str | None = None, goal: str | None = None
) -> dict[str, TensorDict]:
    """The splits ``train`` and ``eval`` of any LeRobot v3.0 dataset, in memory.

    Frames are resized to 64 x 64 with ``cv2.INTER_AREA``, whatever their aspect. Episodes are cut into pieces of T
    steps, T being the length of the shortest, at most 120: as many as cover the episode, evenly spread, so that they
    overlap where T does not divide it. No piece and no window in it crosses the border of an episode. Episodes of less
    than ``min_steps`` are left out. Splits are those that the dataset names ``train`` and ``eval``; without them every
    tenth episode is held out, or the last of less than ten. An episode is in one split with all of its pieces.

    Args:
        min_steps: steps of the windows that will be drawn.
        camera, goal: see :func:`describe_foreign`.

    Returns:
        ``[P, T]`` each: ``pixels`` uint8 ``[P, T, 3, 64, 64]``, ``action`` ``[P, T, A]``, ``goal`` ``[P, T, G]`` (G = 0
        without one), ``("dynamics", quantity)`` ``[P, T, D]`` for the columns that are there, float32 in the dataset's
        units, and ``episode`` int64 ``[P, T, 1]``, its index.

    Raises:
        ValueError: there is no such dataset, it is damaged, or fewer than two episodes are long enough.
    """
    layout = describe_foreign(dataset, camera, goal)
    root, info = layout["root"], layout["info"]
    columns = {
        q if q == "action" else ("dynamics", q): q if q == "action" else f"dynamics.{q}"
        for q in layout["names"]
    }
    goal_column, entries = layout["goal"] or ("action", [])
    table = read_table(root, info, list({*columns.values(), goal_column}))
    numbers = {
        key: read_column(root, info, table, name) for key, name in (columns | {"goal": goal_column}).items()
    }
    numbers["goal"] = numbers["goal"][:, entries]
    rows = dict(spans(table["episode_index"].to_numpy()))
    lengths = {e: r.stop - r.start for e, r in rows.items() if r.stop - r.start >= min_steps}
    if len(lengths) < 2:
        raise ValueError(
            f"{root} has {len(lengths)} episodes of at least {min_steps} steps, and two are needed, one of them held out; "
            "use fewer --window_steps"
        )
    steps = min(LONGEST, *lengths.values())
    splits = _split(root, info, list(lengths))
    parts = {name: [] for name in splits}
    height, width, _ = FRAME_SHAPE
    for episode, frames, _ in iterate_frames(root, info, layout["camera"], size=(width, height)):
        for name in (name for name, members in splits.items() if episode in members):
            own = {key: values[rows[episode]] for key, values in numbers.items()}
            own["pixels"] = torch.from_numpy(frames).permute(0, 3, 1, 2)
            own["episode"] = torch.full((len(frames), 1), episode)
            own = TensorDict(own, [len(frames)])
            parts[name] += [own[start : start + steps] for start in _starts(len(frames), steps)]
    return {name: torch.stack(pieces).contiguous() for name, pieces in parts.items()}


def range_constants(episodes: TensorDict) -> dict[str, dict[str, list[float]]]:
    """``low`` and ``high`` ``[D]`` of action, goal and dynamics ``[E, T]``: the range of all but one in a thousand
    values at either end, in the data's units. An entry that never changes gets the range of 1 about its value.

    A range is all that the data say: an entry that holds nothing but noise is blown up to [-1, 1] like any other, and
    should not be chosen.
    """
    constants = {}
    for key in ("action", "goal", *(("dynamics", q) for q in episodes.get("dynamics", {}).keys())):
        values = episodes[key].flatten(0, 1).double().numpy()  # [N, D]
        low, high = np.quantile(values, [0.001, 0.999], axis=0)
        still = high - low <= 1e-6 * np.maximum(1, np.abs(high))
        low, high = np.where(still, low - 0.5, low), np.where(still, high + 0.5, high)
        constants[key[-1] if isinstance(key, tuple) else key] = {"low": low.tolist(), "high": high.tolist()}
    return constants


def _check_goal(root: Path, info: dict, goal: str | None) -> tuple[str, list[int]] | None:
    if goal is None:
        return None
    column, _, text = goal.rpartition(":")
    entries = parse_entries(text, "--goal: after the colon")
    feature = info["features"].get(column)
    if feature is None or feature["dtype"] not in ("float32", "float64") or len(feature["shape"]) != 1:
        raise ValueError(
            f"--goal is a column of numbers and its entries, as observation.state:3,4, not {goal!r}"
        )
    if not all(0 <= i < feature["shape"][0] for i in entries):
        raise ValueError(f"{root}: {column} has the entries 0 to {feature['shape'][0] - 1}, not {text}")
    return column, entries


def _split(root: Path, info: dict, episodes: list[int]) -> dict[str, list[int]]:
    named = info.get("splits") or {}
    if {"train", "eval"} <= named.keys():
        members = {name: read_split(root, info, name) for name in ("train", "eval")}
        splits = {name: [e for e in episodes if e in members[name]] for name in members}
        if not all(splits.values()):
            raise ValueError(
                f"{root} names splits train and eval, but not both have episodes that are long enough"
            )
        return splits
    held_out = episodes[9::10] or episodes[-1:]
    return {"train": [e for e in episodes if e not in held_out], "eval": held_out}


def _starts(length: int, steps: int) -> list[int]:
    return np.linspace(0, length - steps, -(-length // steps)).round().astype(int).tolist()
