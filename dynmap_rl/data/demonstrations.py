"""Demonstrations of the tasks: LeRobot datasets with dynamics columns as one TensorDict ``[episode, time]``.

The parquet files are read column by column, some ten times faster than frame by frame. LeRobot is not imported: its
import is slow, it creates folders for missing datasets, and it asks the network about damaged ones.
"""

from __future__ import annotations

from numbers import Real
from pathlib import Path

from tensordict import TensorDict

from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.utils.files import check_form

from .cache import open_cached
from .decoding import choose_columns, decode_episodes
from .format.reading import choose_splits, find_dataset, read_info, read_metadata, read_split
from .normalization import normalization_constants

FORMAT = 4  # version of what is recorded, and how
META = "meta/dynmap.json"
DERIVED = "meta/dynamics.json"  # in datasets whose dynamics were derived: how, and how good they are
RANGE = {"low": [Real], "high": [Real]}
META_FORM = {
    "format": int,
    "task": str,
    "kind": str,
    "splits": {"train": [int], "eval": [int]},
    "normalization": dict.fromkeys(("action", "goal", "position", "velocity", "acceleration"), RANGE),
    "episodes": [{"episode_index": int}],
}
NAMES, NUMBERS = ("action", "state", "position", "velocity", "cameras"), ("steps", "fps", "image_size")
LAYOUT_FORM = {
    **{name: [str] for name in NAMES},
    **{name: int for name in NUMBERS},
    "action_limit": [Real],
    "robot": str,
}


def load_dataset(dataset: str | Path, split: str | None = None, cache: Path | None = None) -> TensorDict:
    """Load all episodes of a LeRobot v3.0 dataset, or the episodes of a split.

    The first call decodes the dataset into a cache on disk (see :mod:`dynmap_rl.data.cache`), which the result maps into
    memory: the operating system reads what is used, and processes share it. Changes of the result stay in this process.

    The result has TorchRL's episode data format (TED): observations and action of step t at the root, what follows the
    action under ``next``. Observations are not repeated under ``next``;
    ``torchrl.envs.transforms.NextStateReconstructor`` adds the next observations of a sample.

    A row of the result is one trajectory: ``("next", "done")`` and ``("next", "truncated")`` are true at its last step
    only, and ``terminated`` is never true. Recordings run to the time limit, also after a failure, so that the column
    ``next.done`` of an exploration can be true earlier.

    Args:
        dataset: local folder, or id of a dataset on the Hugging Face hub (``user/name``).
        split: ``train``, ``eval``, or another split that the dataset's ``info.json`` names. By default all episodes, by
            their index, which are copied into memory where the training episodes are not the first ones.
        cache: folder for decoded datasets; by default ``DATASET.cache`` beside the dataset.

    Returns:
        ``[E, T]`` in SI units, numbers as float32, flags as bool. Sizes are those of the recording's layout; of cart and
        block:

        - ``pixels`` uint8 ``[E, T, 3, 64, 64]`` (frames of several cameras side by side), ``agent_pos`` ``[E, T, 5]``,
          ``goal`` ``[E, T, 2]`` (the last entries of ``agent_pos``), ``action`` ``[E, T, 3]``
        - ``("dynamics", "position" | "velocity" | "acceleration")`` ``[E, T, 6]``
        - ``expert_action`` ``[E, T, 3]``, where the dataset has it: what the expert would have done, without noise and
          pushes; imitation learns it
        - ``labelled`` bool ``[E, T, 6]``, where the dataset has the column ``dynamics.found``: what was seen in the frame;
          other positions are interpolated, and the loss of the dynamics leaves them out
        - ``disturbed`` ``[E, T, 1]``: a push acted in the place of the expert; false without such a column
        - ``("next", "reward" | "is_success")`` ``[E, T, 1]``, where the dataset has the columns ``next.reward`` and
          ``next.success``
        - ``done``, ``terminated``, ``truncated`` ``[E, T, 1]``, at the root and under ``next``
        - ``episode`` int64 ``[E, T]``, the index in the dataset, by which TorchRL's ``SliceSampler`` tells episodes apart,
          and ``step_count`` int64 ``[E, T, 1]``, the number of the step

    Raises:
        ValueError: the dataset is missing, damaged, or has another form.
    """
    root = find_dataset(dataset)
    info = read_info(root)
    members = None if split is None else read_split(root, info, split)
    episodes = _open(root, info, find_meta(root), cache)
    index = episodes["episode"][:, 0].tolist()
    rows = sorted((e, row) for row, e in enumerate(index) if members is None or e in members)
    rows = [row for _, row in rows]
    if not rows:
        raise ValueError(
            f"split {split} of {root} must have an episode, got none; restore its meta/info.json"
        )
    return _select(episodes, rows)


def _select(episodes: TensorDict, rows: list[int]) -> TensorDict:
    """Return rows of the cache: a view where they follow each other, otherwise a copy, as a tensor is mapped as a whole."""
    if rows == list(range(rows[0], rows[-1] + 1)):
        return episodes[rows[0] : rows[-1] + 1]
    return episodes[rows]


def load_demonstrations(dataset: str | Path, cache: Path | None = None) -> tuple[dict[str, TensorDict], dict]:
    """Load training and held-out episodes, with the constants of normalisation.

    A dataset without ``meta/dynmap.json``, such as one that LeRobot's tools have edited, is accepted: its constants are
    computed from its training episodes. Without splits ``train`` and ``eval``, every tenth episode is held out, or the
    last one of fewer than ten.

    Args:
        dataset: local folder or hub id.
        cache: see :func:`load_dataset`.

    Returns:
        The episodes by split, ``train`` and ``eval`` (see :func:`load_dataset`), and the constants (see
        :func:`dynmap_rl.data.normalization_constants`).

    Raises:
        ValueError: the dataset is missing, damaged, has another form, or fewer than two episodes.
    """
    root = find_dataset(dataset)
    info, meta = read_info(root), find_meta(root)
    parts = _open(root, info, meta, cache)
    index = parts["episode"][:, 0].tolist()
    splits = choose_splits(root, info, sorted(index))
    rows = {episode: row for row, episode in enumerate(index)}
    episodes = {name: _select(parts, [rows[e] for e in members]) for name, members in splits.items()}
    return episodes, meta["normalization"] if meta else normalization_constants(episodes["train"])


def _open(root: Path, info: dict, meta: dict | None, cache: Path | None) -> TensorDict:
    """Open the decoded episodes: training episodes, held-out ones, then others."""
    layout = find_layout(meta)
    choose_columns(root, info, layout)  # so that messages do not depend on the cache

    def order(episodes: list[int]) -> list[int]:
        try:
            splits = choose_splits(root, info, episodes)
        except ValueError:  # too few for two splits
            return episodes
        chosen = [e for members in splits.values() for e in members]
        return chosen + sorted(set(episodes) - set(chosen))

    def build(allocate) -> None:
        decode_episodes(root, info, layout, order, allocate=allocate)

    return open_cached(root, layout.to_dict(), build, cache)


def load_meta(dataset: str | Path) -> dict:
    """Load what a recording says beside its columns.

    Args:
        dataset: local folder or hub id.

    Returns:
        ``format``, ``task``, ``layout`` (except of cart and block), ``expert``, ``kind``, ``splits`` (name to first
        episode and the one after the last), ``normalization`` (see :func:`dynmap_rl.data.normalization_constants`),
        ``rejected`` (number of failed candidates), and ``episodes``, a dict for each: ``episode_index``, ``split``,
        ``scene_seed``, ``checkpoint``, ``noise``, ``detours``, ``pushes``, ``scene``, ``success``, ``dropped``,
        ``position_error`` (m).

    Raises:
        ValueError: the dataset is missing, or is not a recording of this release.
    """
    root = find_dataset(dataset)
    if (meta := find_meta(root)) is None:
        read_info(root)
        raise ValueError(
            f"{dataset} must be a recording with {META}, got a dataset without it; record one with "
            "recipes/collect.py, or train on this one with recipes/robot.py"
        )
    return meta


def find_meta(root: Path) -> dict | None:
    """Read ``meta/dynmap.json`` of the dataset in a folder; None where it is missing.

    Raises:
        ValueError: the file is damaged, or of another release.
    """
    if not (root / META).exists():
        return None
    meta = read_metadata(root / META)
    if (version := meta.get("format")) != FORMAT:
        raise ValueError(
            f"{root} must be a recording of format {FORMAT}, got format {version}; record it again with "
            "recipes/collect.py"
        )
    meta = read_metadata(root / META, META_FORM)
    if any(len(split) != 2 for split in meta["splits"].values()):
        raise ValueError(
            f"{root / META}: splits must each have two numbers, first and end, got {meta['splits']}; restore the file"
        )
    return meta


def find_layout(meta: dict | None) -> Layout:
    """Return the layout of a recording; a recording of cart and block, and an edited dataset, name none.

    Args:
        meta: content of ``meta/dynmap.json``, or None.

    Raises:
        ValueError: the layout is damaged.
    """
    if meta is None or "layout" not in meta:
        return LAYOUT
    check_form(meta["layout"], LAYOUT_FORM, f"{META}, layout")
    return Layout.from_dict(meta["layout"])
