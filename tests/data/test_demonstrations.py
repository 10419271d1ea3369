"""Loaded demonstrations equal what LeRobot reads; damaged datasets are refused by name."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from dynmap_rl.data.demonstrations import load_dataset, load_demonstrations, load_meta
from dynmap_rl.data.format.quiet import quiet
from dynmap_rl.data.normalization import normalization_constants
from dynmap_rl.keys import CAMERA, DYNAMICS, NEEDED, OPTIONAL


def test_equals_what_lerobot_reads(recording):
    with quiet():
        from lerobot.datasets import LeRobotDataset

        dataset = LeRobotDataset("local/recording", root=recording, video_backend="pyav")
    frames = load_dataset(recording).flatten(0, 1)
    assert len(dataset) == len(frames) == 6 * 120
    for i in (0, 1, 119, 120, 300, 719):
        item, frame = dataset[i], frames[i]
        assert torch.equal(item[CAMERA], frame["pixels"].float() / 255)
        for key, name in (NEEDED | OPTIONAL).items():
            if name == "dynamics.found":  # of derived columns
                continue
            assert item[name].dtype == frame[key].dtype
            assert torch.equal(item[name].reshape(-1), frame[key]), name
        assert item["task"].startswith("Carry the free-standing block")


def test_shapes_and_types(recording):
    episodes = load_dataset(recording)
    flags = ("done", "terminated", "truncated")
    expected = {
        "pixels": ((6, 120, 3, 64, 64), torch.uint8),
        "agent_pos": ((6, 120, 5), torch.float32),
        "goal": ((6, 120, 2), torch.float32),
        "action": ((6, 120, 3), torch.float32),
        "expert_action": ((6, 120, 3), torch.float32),
        **{("dynamics", k): ((6, 120, 6), torch.float32) for k in DYNAMICS},
        "disturbed": ((6, 120, 1), torch.bool),
        ("next", "reward"): ((6, 120, 1), torch.float32),
        ("next", "is_success"): ((6, 120, 1), torch.bool),
        **{flag: ((6, 120, 1), torch.bool) for flag in flags},
        **{("next", flag): ((6, 120, 1), torch.bool) for flag in flags},
        "episode": ((6, 120), torch.int64),
        "step_count": ((6, 120, 1), torch.int64),
    }
    assert set(episodes.keys(True, True)) == set(expected)
    for key, (shape, dtype) in expected.items():
        assert (tuple(episodes[key].shape), episodes[key].dtype) == (shape, dtype), key
        assert episodes[key].is_contiguous()
    assert torch.equal(episodes["goal"], episodes["agent_pos"][..., 3:])


def test_every_episode_is_one_trajectory_cut_off_at_its_end(recording):
    episodes = load_dataset(recording)
    for flag in ("done", "truncated"):
        assert episodes["next", flag][:, -1].all() and not episodes["next", flag][:, :-1].any()
        assert not episodes[flag].any()
    assert not episodes["terminated"].any() and not episodes["next", "terminated"].any()
    held_out = load_dataset(recording, "eval")
    assert held_out["episode"][:, 0].tolist() == [4, 5]
    assert held_out["step_count"][0].flatten().tolist() == list(range(120))


def test_splits_are_the_parts_of_the_whole(recording):
    whole = load_dataset(str(recording))
    train, evaluation = load_dataset(recording, "train"), load_dataset(recording, "eval")
    assert (train.shape[0], evaluation.shape[0]) == (4, 2)
    for key in whole.keys(True, True):
        assert torch.equal(torch.cat([train[key], evaluation[key]]), whole[key])
    with pytest.raises(ValueError, match="'test'"):
        load_dataset(recording, "test")


def test_a_split_that_names_no_episodes_is_refused(copy):
    change_info(copy, lambda info: info.update(splits={"train": "all"}))
    with pytest.raises(ValueError, match="copy must be FIRST:END, got 'all'"):
        load_dataset(copy, "train")


def test_colours_are_in_the_order_red_green_blue(recording):
    episodes, rows = load_dataset(recording), load_meta(recording)["episodes"]
    for episode, row in zip(episodes, rows, strict=True):
        assert episode["pixels"][0, :, 0, 0].tolist() == row["scene"]["background_color"]


@pytest.fixture
def copy(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "copy")


def rewrite(root, change):
    """Apply a function to the tables of the data files."""
    for path in (root / "data").rglob("*.parquet"):
        pq.write_table(change(pq.read_table(path)), path)


def change_info(root, change):
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def replace_column(table, name, values):
    return table.set_column(table.column_names.index(name), name, values)


def not_lerobot(root):
    shutil.rmtree(root / "meta")


def broken_json(root):
    (root / "meta" / "info.json").write_text("{")


def old_version(root):
    change_info(root, lambda info: info.update(codebase_version="v2.1"))


def no_dynamics(root):
    change_info(root, lambda info: info["features"].pop("dynamics.velocity"))


def video(root):
    change_info(root, lambda info: info["features"][CAMERA].update(dtype="video"))


def other_size(root):
    change_info(root, lambda info: info["features"][CAMERA].update(shape=[96, 96, 3]))


def other_dynamics(root):
    """Change the dynamics to two entries, as those of a tracked point."""
    change_info(root, lambda info: info["features"]["dynamics.velocity"].update(shape=[2]))


def truncated(root):
    path = next((root / "data").rglob("*.parquet"))
    path.write_bytes(path.read_bytes()[:-100])


def missing_file(root):
    next((root / "data").rglob("*.parquet")).unlink()


def no_files(root):
    shutil.rmtree(root / "data")


def unequal_lengths(root):
    rewrite(root, lambda table: table.slice(0, len(table) - 1))
    change_info(root, lambda info: info.update(total_frames=info["total_frames"] - 3))


def nan(root):
    def change(table):
        values = np.array(table["action"].to_pylist(), dtype=np.float32)
        values[5, 1] = np.nan
        return replace_column(table, "action", pa.array(values.tolist(), table.schema.field("action").type))

    rewrite(root, change)


def empty_row(root):
    def change(table):
        values = table["next.reward"].to_pylist()
        values[7] = None
        return replace_column(table, "next.reward", pa.array(values, pa.float32()))

    rewrite(root, change)


def another_column(name, value):
    """The same in every row."""

    def damage(root):
        rewrite(root, lambda table: replace_column(table, name, pa.array([value] * len(table))))

    damage.__name__ = f"{name} of {value}"
    return damage


def another_frame(make, name):
    def damage(root):
        def change(table):
            frames = table[CAMERA].to_pylist()
            frames[3]["bytes"] = make(frames[3]["bytes"])
            return replace_column(table, CAMERA, pa.array(frames, table.schema.field(CAMERA).type))

        rewrite(root, change)

    damage.__name__ = name
    return damage


def blank(height, width, kind=".png"):
    import cv2

    return cv2.imencode(kind, np.zeros((height, width, 3), np.uint8))[1].tobytes()


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (not_lerobot, "must be a LeRobot dataset"),
        (broken_json, "info.json cannot be read"),
        (old_version, "v2.1"),
        (no_dynamics, "dynamics.velocity"),
        (video, "must be image, got video"),
        (other_size, r"got \(96, 96, 3\)"),
        (other_dynamics, r"shape \(6,\), got \(2,\).*recipes/robot.py"),
        (truncated, "damaged or unfinished data file"),
        (missing_file, "must have 720 frames, got 480"),
        (no_files, "must have 720 frames, got 0"),
        (unequal_lengths, "119 to 120 steps"),
        (nan, "action"),
        (empty_row, "next.reward"),
        (another_column("action", [0.0] * 4), "action of .* must have 3 numbers"),
        (another_column("next.reward", "much"), "next.reward"),
        (another_column("index", 0.5), "index of .* must be whole numbers"),
        (another_column(CAMERA, 0), f"{CAMERA} of .* must hold image files"),
        (another_frame(lambda png: png[:20], "broken_frame"), "frame 3 cannot be decoded"),
        (another_frame(lambda png: b"", "no_frame"), "frame 3 cannot be decoded"),
        (another_frame(lambda png: blank(32, 64), "small_frame"), r"frame 3 must .* \(32, 64, 3\)"),
        (
            another_frame(lambda png: blank(4000, 3000), "huge_frame"),
            "frame 3 must .* 3000 x 4000",
        ),
        (another_frame(lambda png: blank(400, 300, ".jpg"), "huge_jpeg"), "frame 3 must .* 300 x 400"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_what_is_wrong_is_named_with_the_folder(copy, damage, message):
    damage(copy)
    with pytest.raises(ValueError, match=message) as caught:
        load_dataset(copy)
    assert str(copy) in str(caught.value)


@pytest.mark.parametrize("name", ["missing", "datasets/missing", "someone/missing", "./a/b", "/tmp/a/b/c"])
def test_a_missing_dataset_is_named_and_not_created(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"no dataset at {name}.*recipes/collect.py"):
        load_dataset(name)
    assert list(tmp_path.iterdir()) == []


def test_a_dataset_of_others_has_no_metadata_but_can_be_loaded(copy):
    """As LeRobot's editor leaves a recording, or as a user's own dataset is."""
    pushed = load_dataset(copy)["disturbed"]
    (copy / "meta" / "dynmap.json").unlink()
    with pytest.raises(ValueError, match=r"meta/dynmap\.json"):
        load_meta(copy)
    assert torch.equal(load_dataset(copy)["disturbed"], pushed) and pushed.any()
    for name in ("next.reward", "next.done", "next.success", "disturbed"):
        change_info(copy, lambda info, name=name: info["features"].pop(name))
    episodes = load_dataset(copy)
    assert "reward" not in episodes["next"].keys() and episodes["next", "done"].sum() == 6
    assert not episodes["disturbed"].any()


def test_points_are_not_taken_for_bodies(copy):
    """Six numbers a step too, which augmentation would mirror as angles."""
    (copy / "meta" / "dynmap.json").unlink()
    points = [f"{body}_{axis}" for body in ("cart", "object1", "object2") for axis in "xy"]
    for quantity in ("position", "velocity", "acceleration"):
        change_info(
            copy, lambda info, name=f"dynamics.{quantity}": info["features"][name].update(names=points)
        )
    with pytest.raises(ValueError, match="block_theta, got .*object2_y.*robot.py"):
        load_demonstrations(copy)


def test_demonstrations_are_both_splits_and_the_constants(recording, copy):
    episodes, constants = load_demonstrations(recording)
    for split in ("train", "eval"):
        assert (episodes[split] == load_dataset(recording, split)).all()
    assert constants == load_meta(recording)["normalization"]
    (copy / "meta" / "dynmap.json").unlink()
    assert load_demonstrations(copy)[1] == constants == normalization_constants(episodes["train"])
    change_info(copy, lambda info: info.update(splits={"train": "0:6"}))
    parts, constants = load_demonstrations(copy)
    assert parts["eval"]["episode"][:, 0].tolist() == [5], "the last is held out"
    assert constants == normalization_constants(parts["train"])


def test_the_split_for_training_may_come_last(recording, copy):
    whole, path = load_dataset(recording), copy / "meta" / "dynmap.json"
    change_info(copy, lambda info: info.update(splits={"eval": "0:2", "train": "2:6"}))
    meta = json.loads(path.read_text())
    meta["normalization"]["goal"]["high"] = [7.0, 7.0]
    path.write_text(json.dumps(meta))
    parts, constants = load_demonstrations(copy)
    assert constants["goal"]["high"] == [7.0, 7.0], "those of the recording"
    assert (parts["train"] == whole[2:]).all() and (parts["eval"] == whole[:2]).all()
    assert (load_dataset(copy) == whole).all()


def test_a_recording_of_the_first_release_is_refused_with_what_to_do(copy):
    path = copy / "meta" / "dynmap.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 2}))
    for load in (load_dataset, load_demonstrations, load_meta):
        with pytest.raises(ValueError, match=r"format 2; .*recipes/collect\.py"):
            load(copy)
