"""Robot datasets: any LeRobot v3.0 dataset with an action and a camera, as pieces of equal length.

A robot dataset has no scene, cart or goal marker, no simulator to try a policy in, and no symmetry to augment by. Its
frames are resized, its episodes cut and divided, and its numbers normalised by general rules.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from dynmap_rl.keys import DYNAMICS, FOUND
from dynmap_rl.utils.settings import parse_numbers

from .format.frames import choose_camera, iterate_frames
from .format.reading import choose_splits, find_dataset, is_vector, read_column, read_info, read_table, spans
from .normalization import range_constants
from .state import entry_names

LONGEST = 120  # steps of a piece; longer pieces make batches of whole pieces slow


def describe_robot_dataset(
    dataset: str | Path,
    camera: str | None = None,
    goal: str | None = None,
    supervision: tuple[str, ...] = (),
    min_steps: int = 1,
) -> dict:
    """Check what would be loaded of a robot dataset, before any frame is read.

    Args:
        dataset: local folder or hub id.
        camera: column of the frames, or several with commas between; by default the first camera.
        goal: ``COLUMN:ENTRIES``, such as ``observation.state:3,4``; by default no goal.
        supervision: quantities of the dynamics whose columns must exist.
        min_steps: steps of the windows that will be drawn.

    Returns:
        ``root``, ``info`` (content of ``meta/info.json``), ``cameras``, ``goal`` (column and entries, or None), ``names``
        (of the entries of ``action`` and of every dynamics quantity that the dataset has), ``steps`` (T of the pieces),
        ``splits`` (episodes of ``train`` and ``eval``), ``left_out`` (episodes that are too short) and ``lengths``
        (steps of every episode).

    Raises:
        ValueError: the dataset is missing or damaged, lacks a column, or has too few episodes that are long enough.
    """
    root = find_dataset(dataset)
    info = read_info(root)
    features = info["features"]
    if "action" not in features:
        raise ValueError(f"{root} must have a column action; choose a dataset of demonstrations")
    if missing := [f"dynamics.{q}" for q in supervision if f"dynamics.{q}" not in features]:
        raise ValueError(
            f"{root} must have the columns {', '.join(missing)}; add dynamics with recipes/add_dynamics.py, or train "
            "with --world_model.supervision none"
        )
    views = [name.strip() for name in camera.split(",")] if camera else [None]
    columns = {"action": "action"} | {q: f"dynamics.{q}" for q in DYNAMICS if f"dynamics.{q}" in features}
    views = [choose_camera(root, info, name) for name in views]
    goal = _check_goal(info, goal)
    rows = spans(read_table(root, info, [])["episode_index"].to_numpy())
    lengths = {episode: span.stop - span.start for episode, span in rows}
    usable = [episode for episode, length in lengths.items() if length >= min_steps]
    if len(usable) < 2 <= len(lengths):
        raise ValueError(
            f"{root} must have two episodes of at least {min_steps} steps, the length of windows, but the second longest has "
            f"{sorted(lengths.values())[-2]}; choose a shorter window_steps, or record longer episodes"
        )
    splits = choose_splits(root, info, [*lengths], usable)
    steps = _choose_steps(lengths, splits, min_steps)
    splits = {name: [e for e in members if lengths[e] >= steps] for name, members in splits.items()}
    return {
        "root": root,
        "info": info,
        "cameras": views,
        "goal": goal,
        "names": {key: entry_names(info, column) for key, column in columns.items()},
        "steps": steps,
        "splits": splits,
        "left_out": [episode for episode, length in lengths.items() if length < steps],
        "lengths": lengths,
    }


def load_robot_dataset(
    dataset: str | Path,
    min_steps: int,
    camera: str | None = None,
    goal: str | None = None,
    image_size: int = 64,
    only: str | None = None,
) -> tuple[dict[str, TensorDict], dict]:
    """Load training and held-out pieces of any LeRobot v3.0 dataset, with constants of normalisation.

    Frames are resized to S x S with ``cv2.INTER_AREA``, whatever their aspect; those of several cameras stand side by
    side. Episodes are cut into pieces of T steps, at most 120, or ``min_steps`` if that is more. Of the episodes with
    ``min_steps``, a tenth may be shorter than T, but not all of a split, so that a few short takes do not shorten all
    pieces; all shorter episodes are left out. As many pieces as needed cover an episode, evenly spread; they overlap where
    T does not divide its length. No piece crosses the border of an episode. Splits named ``train`` and ``eval``, ``test``
    or ``val`` are kept; otherwise every tenth episode of all is held out, or the last one that is long enough where there
    is none of these. All pieces of an episode are in one split.

    Args:
        dataset: local folder or hub id.
        min_steps: steps of the windows that will be drawn.
        camera: column of the frames, or several with commas between; by default the first camera.
        goal: ``COLUMN:ENTRIES``, such as ``observation.state:3,4``; by default no goal.
        image_size: S, a multiple of 8.
        only: the split that is loaded, ``train`` or ``eval``; by default both are.

    Returns:
        The pieces by split, ``train`` and ``eval``, and the constants (``low`` and ``high`` ``[D]`` of action, goal and
        every quantity of the dynamics) of the training pieces, or of those of ``only``. Pieces are ``[P, T]``: ``pixels``
        uint8 ``[P, T, 3, S, cameras * S]``, ``action``
        ``[P, T, A]``, ``goal`` ``[P, T, G]`` (G = 0 without a goal), ``("dynamics", quantity)`` ``[P, T, D]`` for the
        columns that the dataset has, float32 in its units, ``disturbed`` bool ``[P, T, 1]`` where the dataset has such a
        column of flags, likewise ``expert_action`` ``[P, T, A]``, the action to imitate, and ``labelled`` bool
        ``[P, T, D]`` (see :func:`dynmap_rl.data.load_dataset`), ``episode`` int64 ``[P, T]``, the episode's index, and ``step_count`` int64 ``[P, T, 1]``, the number of the step in its episode.

    Raises:
        ValueError: the dataset is missing or damaged, or fewer than two episodes are long enough.
    """
    layout = describe_robot_dataset(dataset, camera, goal, min_steps=min_steps)
    root, info, splits, steps = (layout[key] for key in ("root", "info", "splits", "steps"))
    numbers, rows = _read_numbers(layout)
    if only not in (None, *splits):
        raise ValueError(f"only must be one of {', '.join(splits)}, got {only!r}")
    splits = {name: members for name, members in splits.items() if only in (None, name)}
    lengths = {episode: own.stop - own.start for episode, own in rows.items()}
    pieces = {
        name: [(episode, start) for episode in members for start in _starts(lengths[episode], steps)]
        for name, members in splits.items()
    }
    shape = 3, image_size, image_size * len(layout["cameras"])
    episodes = {name: _make_pieces(numbers, rows, own, steps, shape) for name, own in pieces.items()}
    places = defaultdict(list)  # of the pieces of an episode
    for name, own in pieces.items():
        for i, (episode, start) in enumerate(own):
            places[episode].append((episodes[name]["pixels"][i], start))
    size = image_size, image_size
    sources = [iterate_frames(root, info, name, size=size, only=places.keys()) for name in layout["cameras"]]
    for views in zip(*sources, strict=True):
        frames = np.concatenate([frames for _, frames, _ in views], 2)
        frames = torch.from_numpy(frames).permute(0, 3, 1, 2)
        for place, start in places[views[0][0]]:
            place[:] = frames[start : start + steps]
    return episodes, range_constants(next(iter(episodes.values())))


def _make_pieces(
    numbers: dict, rows: dict[int, slice], pieces: list[tuple[int, int]], steps: int, shape: tuple[int, ...]
) -> TensorDict:
    """Return pieces ``[P, T]`` of episodes, each given by its episode and its first step, with empty frames."""
    episode, start = torch.tensor(pieces).T
    step = start[:, None] + torch.arange(steps)
    index = torch.tensor([rows[e].start for e, _ in pieces])[:, None] + step
    data = {key: values[index] for key, values in numbers.items()}
    data["pixels"] = torch.empty(len(pieces), steps, *shape, dtype=torch.uint8)
    data["episode"], data["step_count"] = episode[:, None].repeat(1, steps), step[..., None]
    return TensorDict(data, [len(pieces), steps])


def _read_numbers(layout: dict) -> tuple[dict, dict[int, slice]]:
    """Return numbers ``[N, D]`` by key, and the rows of every episode."""
    root, info = layout["root"], layout["info"]
    columns = {
        q if q == "action" else ("dynamics", q): q if q == "action" else f"dynamics.{q}"
        for q in layout["names"]
    }
    pushes = info["features"].get("disturbed", {})
    if (pushes.get("dtype"), pushes.get("shape")) == ("bool", [1]):
        columns["disturbed"] = "disturbed"
    expert = info["features"].get("expert_action")
    if expert and is_vector(expert) and expert["shape"] == info["features"]["action"]["shape"]:
        columns["expert_action"] = "expert_action"
    if FOUND in info["features"]:
        columns["labelled"] = FOUND
    goal, entries = layout["goal"] or ("action", [])
    table = read_table(root, info, list({*columns.values(), goal}))
    numbers = {key: read_column(root, info, table, name) for key, name in (columns | {"goal": goal}).items()}
    numbers["goal"] = numbers["goal"][:, entries].float()
    return numbers, dict(spans(table["episode_index"].to_numpy()))


def _check_goal(info: dict, goal: str | None) -> tuple[str, list[int]] | None:
    if goal is None:
        return None
    column, _, text = goal.rpartition(":")
    feature = info["features"].get(column)
    if feature is None or not is_vector(feature):
        known = ", ".join(name for name, feature in info["features"].items() if is_vector(feature))
        raise ValueError(
            f"--goal must be a column and its entries, such as observation.state:3,4, got {goal!r}; columns are {known}"
        )
    entries = parse_numbers(text, "--goal: entries after the colon")
    if not all(0 <= i < feature["shape"][0] for i in entries):
        raise ValueError(f"--goal: entries of {column} must be 0 to {feature['shape'][0] - 1}, got {text}")
    return column, entries


def _choose_steps(lengths: dict[int, int], splits: dict[str, list[int]], min_steps: int) -> int:
    """Return the steps of the pieces: a tenth of the episodes may be shorter, but not all of a split."""
    by_split = [[lengths[episode] for episode in members] for members in splits.values()]
    shortest = int(np.quantile(np.concatenate(by_split), 0.1, method="lower"))
    return min(max(LONGEST, min_steps), shortest, *map(max, by_split))


def _starts(length: int, steps: int) -> list[int]:
    """Return the first steps of the pieces of an episode."""
    return np.linspace(0, length - steps, -(-length // steps)).round().astype(int).tolist()
