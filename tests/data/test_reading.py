"""Tables of a dataset and its division into episodes for training and held-out ones."""

from pathlib import Path

import cv2
import lerobot.utils.constants
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from datasets.features.features import Array2DExtensionType

from dynmap_rl.data.format.frames import choose_camera, iterate_frames, join_views
from dynmap_rl.data.format.reading import choose_splits, find_dataset, read_column, read_table
from dynmap_rl.data.state import entry_names
from dynmap_rl.utils.files import write_json


def test_every_tenth_episode_is_held_out():
    splits = choose_splits(Path(), {}, list(range(25)))
    assert splits["eval"] == [9, 19] and splits["train"] == [e for e in range(25) if e not in (9, 19)]


def test_an_episode_is_held_out_where_every_tenth_is_left_out():
    splits = choose_splits(Path(), {}, list(range(12)), usable=set(range(12)) - {9})
    assert splits["eval"] == [11] and splits["train"] == [*range(9), 10]
    splits = choose_splits(Path(), {}, list(range(8)), usable=range(7))
    assert splits == {"train": [*range(6)], "eval": [6]}


def test_what_is_held_out_does_not_depend_on_what_is_left_out():
    splits = choose_splits(Path(), {}, list(range(25)), usable=set(range(25)) - {3, 9})
    assert splits["eval"] == [19] and not {3, 9, 19} & {*splits["train"]} and len(splits["train"]) == 22
    named = {"splits": {"train": "0:3", "test": "3:5"}}
    assert choose_splits(Path(), named, list(range(5))) == {"train": [0, 1, 2], "eval": [3, 4]}


def test_rows_are_in_order_of_time(tmp_path):
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    for number, index in enumerate(([2, 3], [0, 1])):
        table = pa.table({"index": index, "episode_index": [0, 0]})
        pq.write_table(table, tmp_path / f"data/chunk-000/file-{number:03}.parquet")
    info = {"total_frames": 4, "features": {}}
    assert read_table(tmp_path, info, [])["index"].to_pylist() == [0, 1, 2, 3]
    assert read_table(tmp_path, info, [], by_time=False)["index"].to_pylist() == [2, 3, 0, 1]


def test_lists_of_fixed_and_of_variable_size_are_one_column(tmp_path):
    """LeRobot stores the former where it records, and the latter where it merges."""
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    for number, kind in enumerate((pa.list_(pa.float32()), pa.list_(pa.float32(), 2))):
        column = pa.array([[number, 1.0], [number, 2.0]], kind)
        rows = {"index": [2 * number, 2 * number + 1], "episode_index": [number] * 2, "action": column}
        pq.write_table(pa.table(rows), tmp_path / f"data/chunk-000/file-{number:03}.parquet")
    info = {"total_frames": 4, "features": {"action": {"shape": [2]}}}
    table = read_table(tmp_path, info, ["action"])
    assert read_column(tmp_path, info, table, "action").tolist() == [[0, 1], [0, 2], [1, 1], [1, 2]]


@pytest.mark.parametrize("index", [[0, 1, 1, 2], [0, 1, 0, 1], [1, 2, 3, 4]])
def test_an_index_that_does_not_number_the_frames_is_refused(tmp_path, index):
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    table = pa.table({"index": index, "episode_index": [0, 0, 1, 1]})
    pq.write_table(table, tmp_path / "data/chunk-000/file-000.parquet")
    with pytest.raises(ValueError, match="number all frames"):
        read_table(tmp_path, {"total_frames": 4, "features": {}}, [])


def test_an_episode_in_two_blocks_is_refused(tmp_path):
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    table = pa.table({"index": range(4), "episode_index": [0, 1, 0, 1]})
    pq.write_table(table, tmp_path / "data/chunk-000/file-000.parquet")
    with pytest.raises(ValueError, match="one block"):
        read_table(tmp_path, {"total_frames": 4, "features": {}}, [])


def test_a_matrix_in_each_row_is_read_with_and_without_the_type_of_datasets():
    values = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    info = {"features": {"action": {"shape": [2, 3]}}}
    matrix = Array2DExtensionType((2, 3), "float32")
    typed = pa.ExtensionArray.from_storage(matrix, pa.array(values.tolist(), matrix.storage_type))
    for column in (typed, typed.storage):
        read = read_column(Path(), info, pa.table({"action": column}), "action")
        assert read.tolist() == values.reshape(2, 6).tolist()


def test_frames_are_in_order_of_time_too(tmp_path):
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    images = [
        cv2.imencode(".png", np.full((8, 8, 3), value, np.uint8))[1].tobytes() for value in (30, 20, 10)
    ]
    frames = [{"bytes": image, "path": None} for image in images]
    rows = {"index": [2, 1, 0], "episode_index": [1, 0, 0], "timestamp": [0.0, 0.1, 0.0], "top": frames}
    pq.write_table(pa.table(rows), tmp_path / "data/chunk-000/file-000.parquet")
    info = {"features": {"top": {"dtype": "image", "shape": [8, 8, 3]}}}
    read = {
        episode: frames[:, 0, 0, 0].tolist() for episode, frames, _ in iterate_frames(tmp_path, info, "top")
    }
    assert read == {0: [10, 20], 1: [30]}


def test_a_side_is_averaged_where_it_is_reduced_though_the_other_is_enlarged():
    view = np.zeros((16, 128, 3), np.uint8)
    view[:, ::4] = 200  # stripes of a pixel, which interpolation between two neighbours misses
    assert (join_views([view], 32) == 50).all()


def test_pictures_of_another_form_are_refused():
    for view in (np.zeros((3, 16, 16), np.uint8), np.zeros((16, 16, 3)), np.zeros((16, 16), np.uint8)):
        with pytest.raises(ValueError, match="height, width, 3"):
            join_views([view])


def test_frames_of_two_sizes_are_refused(tmp_path):
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    images = [cv2.imencode(".png", np.zeros((side, 8, 3), np.uint8))[1].tobytes() for side in (8, 6)]
    frames = [{"bytes": image, "path": None} for image in images]
    table = pa.table({"index": [0, 1], "episode_index": [0, 0], "timestamp": [0.0, 0.1], "top": frames})
    pq.write_table(table, tmp_path / "data/chunk-000/file-000.parquet")
    info = {"features": {"top": {"dtype": "image", "shape": [8, 8, 3]}}}
    with pytest.raises(ValueError, match="episode 0 must have one size"):
        next(iterate_frames(tmp_path, info, "top"))


def test_an_id_is_looked_for_where_lerobot_records(tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot.utils.constants, "HF_LEROBOT_HOME", tmp_path)
    with pytest.raises(ValueError, match=str(tmp_path)):
        find_dataset("me/mine")
    write_json(tmp_path / "me/mine/meta/info.json", {})
    assert find_dataset("me/mine") == tmp_path / "me/mine"


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["a", "b", "a"], ["a_0", "b", "a_2"]),
        ({"left": ["j0", "grip"], "right": ["j0"]}, ["left_j0", "grip", "right_j0"]),
        ({"delta_y": 1, "delta_x": 0, "gripper": 2}, ["delta_x", "delta_y", "gripper"]),
        ({"motors": ["a", "b"]}, ["0", "1", "2"]),
        (["a_1", "a", "a"], ["0", "1", "2"]),
        (None, ["0", "1", "2"]),
    ],
)
def test_every_entry_of_a_column_has_a_name_of_its_own(names, expected):
    assert entry_names({"features": {"action": {"shape": [3], "names": names}}}, "action") == expected


def test_a_depth_map_is_no_camera():
    depth, color = (
        {"dtype": "video", "shape": [64, 64, 3], "info": {"is_depth_map": d}} for d in (True, False)
    )
    assert choose_camera(Path(), {"features": {"depth": depth, "color": color}}) == "color"
    for features in (
        {"depth": depth},
        {"depth": {"dtype": "video", "video_info": {"video.is_depth_map": True}}},
    ):
        with pytest.raises(ValueError, match="with colours"):
            choose_camera(Path(), {"features": features}, "depth")
