"""Robot datasets: pieces, splits, frames and constants."""

import json
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from robot_dataset import CAMERA, make_robot_dataset

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.data.format.frames import join_views
from dynmap_rl.data.format.images import decode_image
from dynmap_rl.data.robot import describe_robot_dataset, load_robot_dataset
from dynmap_rl.data.windows import sample_windows
from dynmap_rl.objectives.imitation import find_target

LENGTHS = (31, 47, 24, 33)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """By name: without dynamics, with them, and the same with frames in videos."""
    root = tmp_path_factory.mktemp("robot")
    make_robot_dataset(root / "plain", LENGTHS)
    make_robot_dataset(root / "plain_videos", LENGTHS, videos=True)
    for name in ("plain", "plain_videos"):
        add_dynamics(root / name, root / name.replace("plain", "dynamics"), columns=[0, 1, 2], angles=[2])
    return root


@pytest.fixture(scope="module")
def splits(folders):
    return load_robot_dataset(folders / "dynamics", 20)[0]


def column(root, name):
    [path] = (root / "data").rglob("*.parquet")
    return np.array(pq.read_table(path)[name].to_pylist(), np.float32)


def test_shapes_are_those_of_the_data(splits):
    # The shortest episode has 24 steps; 31, 47 and 24 steps are covered by 2, 2 and 1 pieces, 33 by 2.
    assert (splits["train"].shape, splits["eval"].shape) == ((5, 24), (2, 24))
    train = splits["train"]
    assert train["pixels"].shape == (5, 24, 3, 64, 64) and train["pixels"].dtype == torch.uint8
    assert (train["action"].shape[-1], train["goal"].shape[-1]) == (2, 0)
    assert train["dynamics", "velocity"].shape == (5, 24, 3)
    assert train["action"].dtype == train["dynamics", "position"].dtype == torch.float32


def test_pieces_cover_every_step_of_their_episode_and_no_other(folders, splits):
    position, start = column(folders / "dynamics", "dynamics.position"), 0
    everything = torch.cat([splits["train"], splits["eval"]])
    for episode, length in enumerate(LENGTHS):
        own = torch.from_numpy(position[start : start + length])
        found = everything[(everything["episode"] == episode).all(1).flatten()]["dynamics", "position"]
        places = [[int((own == row).all(1).nonzero()[0]) for row in piece] for piece in found]
        assert all(piece == list(range(piece[0], piece[0] + 24)) for piece in places)
        assert {t for piece in places for t in piece} == set(range(length))
        start += length


def test_no_window_crosses_a_border(splits):
    windows = sample_windows(splits["train"], 64, 10, torch.Generator().manual_seed(0))
    assert (windows["episode"] == windows["episode"][:, :1]).all()
    # The squares glide evenly: a step over a border would be longer.
    steps = windows["dynamics", "position"].diff(dim=1)[..., :2]
    assert (steps - steps[:, :1]).abs().max() < 1e-5


def test_no_episode_is_in_both_splits(splits):
    train, held_out = (set(splits[name]["episode"].flatten().tolist()) for name in ("train", "eval"))
    assert (train, held_out) == ({0, 1, 2}, {3})


def test_splits_that_the_dataset_names_are_kept(folders, tmp_path):
    root = make_robot_dataset(tmp_path / "named", (12, 12, 12))
    path = root / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"splits": {"eval": "0:1", "train": "1:3"}}))
    splits, _ = load_robot_dataset(root, 5)
    assert splits["eval"]["episode"].unique().tolist() == [0]
    assert splits["train"]["episode"].unique().tolist() == [1, 2]


def test_splits_that_share_episodes_are_refused(tmp_path):
    root = make_robot_dataset(tmp_path / "named", (12, 12, 12))
    path = root / "meta/info.json"  # LeRobot writes the split train of all episodes
    path.write_text(json.dumps(json.loads(path.read_text()) | {"splits": {"train": "0:3", "eval": "2:3"}}))
    with pytest.raises(ValueError, match="must not share episodes, got 2 to 2"):
        load_robot_dataset(root, 5)


def test_episodes_that_are_too_short_are_left_out_and_long_ones_cut(tmp_path):
    root = make_robot_dataset(tmp_path / "lengths", (130, 8, 125))
    splits, _ = load_robot_dataset(root, 20)
    assert splits["train"].shape == (2, 120)
    assert load_robot_dataset(root, 122)[0]["train"].shape == (2, 122)
    with pytest.raises(ValueError, match="lengths must"):
        load_robot_dataset(root, 128)


def test_a_short_take_neither_shortens_the_pieces_nor_changes_what_is_held_out(tmp_path):
    root = make_robot_dataset(tmp_path / "takes", [12, *range(30, 50)])
    found = [describe_robot_dataset(root, min_steps=steps) for steps in (10, 24)]
    assert [one["steps"] for one in found] == [31, 31], "a tenth of 21 episodes may be shorter"
    assert [one["left_out"] for one in found] == [[0, 1], [0, 1]]
    assert [one["splits"]["eval"] for one in found] == [[9, 19], [9, 19]]
    assert load_robot_dataset(root, 10)[0]["eval"].shape == (4, 31)


@pytest.mark.parametrize(
    ("lengths", "steps", "held_out"),
    [
        ([30] * 9 + [29] + [30] * 2, 29, [9]),  # the only one that is held out
        ([30] * 9 + [5] + [30] * 2, 30, [11]),
        ([30, 30, 30, 5], 30, [2]),
    ],
)
def test_a_short_take_may_be_the_one_that_is_held_out(tmp_path, lengths, steps, held_out):
    found = describe_robot_dataset(make_robot_dataset(tmp_path / "takes", lengths), min_steps=10)
    assert (found["steps"], found["splits"]["eval"]) == (steps, held_out)
    assert found["lengths"] == dict(enumerate(lengths))


def test_windows_longer_than_episodes_are_refused_with_the_lengths(tmp_path):
    root = make_robot_dataset(tmp_path / "takes", [12, 30, 14])
    with pytest.raises(ValueError, match="two episodes of at least 24 steps.* second longest has 14"):
        describe_robot_dataset(root, min_steps=24)


def test_a_number_that_is_missing_is_named_with_its_place(folders, tmp_path):
    root = shutil.copytree(folders / "dynamics", tmp_path / "broken")
    [path] = (root / "data").rglob("*.parquet")
    table = pq.read_table(path)
    actions = table["action"].to_pylist()
    actions[40] = [float("nan"), 0.5]
    at = table.column_names.index("action")
    field = table.schema.field(at)
    pq.write_table(table.set_column(at, field, pa.array(actions, field.type)), path)
    with pytest.raises(ValueError, match=r"action .*nan.* in row 40, episode 1"):
        load_robot_dataset(root, 20)


def test_frames_are_resized_by_area_and_keep_their_colours(splits):
    frames = splits["train"]["pixels"][0, 0]
    assert frames[:, 0, 0].tolist() == [190] * 3
    red = (frames[0].int() - frames[1] > 100).float()
    assert red.any(), "red, not blue"
    y, x = red.nonzero().float().mean(0)
    position = splits["train"]["dynamics", "position"][0, 0]
    assert abs((x + 0.5) / 64 - position[0]) < 0.03 and abs((y + 0.5) / 64 - position[1]) < 0.03


def test_frames_of_several_cameras_and_another_size_stand_side_by_side(folders, splits):
    both = f"{CAMERA},{CAMERA}"
    train = load_robot_dataset(folders / "dynamics", 20, both, image_size=32)[0]["train"]
    assert train["pixels"].shape[2:] == (3, 32, 64)
    left, right = train["pixels"].split(32, -1)
    assert torch.equal(left, right)
    reduced = torch.nn.functional.avg_pool2d(splits["train"]["pixels"][0].float(), 2)
    assert (reduced - left[0]).abs().mean() < 4
    with pytest.raises(ValueError, match="--camera must be one of"):
        load_robot_dataset(folders / "dynamics", 20, f"{CAMERA},front")


def test_views_of_a_robot_are_joined_as_for_training(folders):
    train = load_robot_dataset(folders / "dynamics", 20, f"{CAMERA},{CAMERA}", image_size=32)[0]["train"]
    [path] = (folders / "dynamics/data").rglob("*.parquet")
    picture = decode_image(pa.py_buffer(pq.read_table(path)[CAMERA][0].as_py()["bytes"]), 96 * 128)
    frame = join_views([picture, picture], 32)
    assert torch.equal(torch.from_numpy(frame).movedim(-1, 0), train["pixels"][0, 0])


def test_videos_give_nearly_the_frames_of_images(folders, splits):
    videos = load_robot_dataset(folders / "dynamics_videos", 20)[0]["train"]
    assert (videos["pixels"].float() - splits["train"]["pixels"]).abs().mean() < 2
    assert torch.equal(videos["action"], splits["train"]["action"])


def test_a_goal_of_chosen_entries(folders):
    train = load_robot_dataset(folders / "plain", 20, goal="observation.state:3,0")[0]["train"]
    assert train["goal"].shape == (5, 24, 2)
    assert (train["goal"][..., 0] == 0).all()
    assert train["goal"][0, 0, 1].item() == column(folders / "plain", "observation.state")[0, 0]
    assert "dynamics" not in train.keys()


def test_a_goal_may_be_the_number_of_the_task(folders):
    goal = load_robot_dataset(folders / "plain", 20, goal="task_index:0")[0]["train"]["goal"]
    assert goal.dtype == torch.float32 and goal.shape[-1] == 1 and (goal == 0).all()


def test_constants_are_the_ranges_and_a_still_entry_gets_one(folders, splits):
    _, constants = load_robot_dataset(folders / "dynamics", 20)
    assert constants.keys() == {"action", "goal", "position", "velocity", "acceleration"}
    for key in ("action", ("dynamics", "position")):
        values = splits["train"][key].flatten(0, 1)
        name = key if key == "action" else "position"
        low, high = torch.tensor(constants[name]["low"]), torch.tensor(constants[name]["high"])
        assert (((values - low) / (high - low) - 0.5).abs() < 0.53).all()
        assert (high - low <= values.amax(0) - values.amin(0) + 1e-6).all()
    _, constants = load_robot_dataset(folders / "plain", 20, goal="observation.state:3")
    assert constants["goal"] == {"low": [-0.5], "high": [0.5]}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera": "front"}, f"--camera .*{CAMERA}"),
        ({"goal": "observation.state"}, "--goal"),
        ({"goal": "nothing:1"}, "--goal .*nothing:1.*observation.state"),
        ({"goal": "observation.state:4"}, "--goal.* 0 to 3, got 4"),
    ],
)
def test_what_is_not_there_is_named(folders, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_robot_dataset(folders / "plain", 20, **arguments)


def test_a_video_outside_of_the_dataset_is_not_opened(folders, tmp_path):
    root = shutil.copytree(folders / "plain_videos", tmp_path / "copy")
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"video_path": "../" + info["video_path"]}))
    with pytest.raises(ValueError, match="video_path"):
        load_robot_dataset(root, 20)


def test_videos_that_are_nowhere_are_named(folders, tmp_path):
    root = shutil.copytree(folders / "plain_videos", tmp_path / "copy")
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    for place in (None, "{nothing}"):
        path.write_text(json.dumps(info | {"video_path": place}))
        with pytest.raises(ValueError, match="place of its videos"):
            load_robot_dataset(root, 20)
    path.write_text(json.dumps(info))
    shutil.rmtree(root / "meta/episodes")
    with pytest.raises(ValueError, match="place of its videos"):
        load_robot_dataset(root, 20)


def test_a_damaged_video_is_named(folders, tmp_path):
    root = shutil.copytree(folders / "plain_videos", tmp_path / "copy")
    [path] = root.rglob("*.mp4")
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ValueError, match=f"{path} cannot be decoded"):
        load_robot_dataset(root, 20)


def test_the_expert_s_action_is_to_be_imitated(recording):
    """A recording of a task may be loaded as that of a robot; its actions are noisy."""
    episodes = torch.cat(list(load_robot_dataset(recording, 20)[0].values()))
    assert not torch.equal(episodes["action"], episodes["expert_action"])
    torch.testing.assert_close(find_target(episodes)[0], episodes["expert_action"])


def test_one_split_alone(folders, splits):
    alone, constants = load_robot_dataset(folders / "dynamics", 20, only="eval")
    assert list(alone) == ["eval"] and (alone["eval"] == splits["eval"]).all()
    assert len(constants["action"]["low"]) == 2
    with pytest.raises(ValueError, match="one of train, eval, got 'test'"):
        load_robot_dataset(folders / "dynamics", 20, only="test")
