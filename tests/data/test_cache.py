"""The cache of decoded episodes: reused, rebuilt when stale, whole or missing, and never changed by its readers."""

import json
import os
import shutil
from collections import namedtuple

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.data import demonstrations
from dynmap_rl.data.cache import _map, hash_content
from dynmap_rl.data.decoding import decode_episodes
from dynmap_rl.data.demonstrations import load_dataset, load_demonstrations
from dynmap_rl.data.format.reading import read_info
from dynmap_rl.envs.task import LAYOUT


@pytest.fixture
def copy(recording, tmp_path):
    return shutil.copytree(recording, tmp_path / "copy")


@pytest.fixture
def decoded(monkeypatch):
    """Return the list of the folders that were decoded."""
    folders = []

    def decode(root, *arguments, **options):
        folders.append(root)
        return decode_episodes(root, *arguments, **options)

    monkeypatch.setattr(demonstrations, "decode_episodes", decode)
    return folders


def change_info(root, change):
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def list_entries(root):
    return [path for path in root.with_name(f"{root.name}.cache").iterdir() if path.is_dir()]


def test_a_dataset_is_decoded_once_and_nothing_is_put_into_its_folder(copy, decoded):
    before = sorted(copy.rglob("*"))
    episodes = load_dataset(copy)
    splits, _ = load_demonstrations(copy)
    assert decoded == [copy] and sorted(copy.rglob("*")) == before
    expected = decode_episodes(copy, read_info(copy), LAYOUT)
    assert set(episodes.keys(True, True)) == set(expected.keys(True, True))
    assert (episodes == expected).all() and episodes.shape == expected.shape
    assert (splits["train"] == expected[:4]).all() and (splits["eval"] == expected[4:]).all()


def test_changes_of_the_result_stay_in_the_process(copy, decoded):
    episodes = load_dataset(copy)
    before = episodes["action"].clone()
    episodes["action"] += 1
    assert torch.equal(load_dataset(copy)["action"], before) and decoded == [copy]


def test_a_changed_file_makes_the_cache_stale(copy, decoded):
    load_dataset(copy)
    (old,) = list_entries(copy)
    file = next(copy.glob("data/*/*.parquet"))
    file.write_bytes(file.read_bytes())  # the same content
    load_dataset(copy)
    assert decoded == [copy]
    change_info(copy, lambda info: info["features"].pop("disturbed"))
    assert not load_dataset(copy)["disturbed"].any()
    assert decoded == [copy, copy] and old not in list_entries(copy) and len(list_entries(copy)) == 1


@pytest.mark.parametrize("name", ["action.memmap", "meta.json", "sizes.json"])
def test_an_entry_that_was_cut_short_is_built_again(copy, decoded, name):
    episodes = load_dataset(copy).clone()  # reading a map of a shorter file ends the process
    (entry,) = list_entries(copy)
    os.truncate(entry / name, (entry / name).stat().st_size // 2)
    assert (load_dataset(copy) == episodes).all()
    assert decoded == [copy, copy] and list_entries(copy) == [entry]
    assert (load_dataset(copy) == episodes).all() and len(decoded) == 2


def test_a_kill_while_a_stale_entry_is_deleted_leaves_no_part_of_it(copy, monkeypatch):
    load_dataset(copy)
    (old,) = list_entries(copy)
    rmtree = shutil.rmtree

    def stop(path, **options):
        if options.get("ignore_errors") and path.stem == old.name:
            next(path.rglob("*.memmap")).unlink()
            raise KeyboardInterrupt
        return rmtree(path, **options)

    change_info(copy, lambda info: info.update(robot_type="other"))
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "rmtree", stop)
        with pytest.raises(KeyboardInterrupt):
            load_dataset(copy)
    assert not old.exists()


def test_the_hash_of_a_dataset_is_that_of_its_videos_too(copy):
    before, video = hash_content(copy), copy / "videos/observation.images.top/chunk-000/file-000.mp4"
    video.parent.mkdir(parents=True)
    video.write_bytes(b"frames")
    first = hash_content(copy)
    video.write_bytes(b"others")
    assert len({before, first, hash_content(copy)}) == 3


def test_an_interrupted_build_leaves_no_entry(copy, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(demonstrations, "decode_episodes", lambda *_, allocate, **__: interrupt(allocate))
        with pytest.raises(KeyboardInterrupt):
            load_dataset(copy)
    assert list_entries(copy) == []
    leftover = copy.with_name("copy.cache") / "killed.tmp"
    leftover.mkdir()
    assert load_dataset(copy).shape == (6, 120) and not leftover.exists()


def interrupt(allocate):
    allocate("pixels", (2, 3), torch.uint8)
    raise KeyboardInterrupt


def test_a_full_disk_is_one_line_that_names_the_option(copy, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 9, 1))
    with pytest.raises(OSError, match=r"copy\.cache .* are needed.*--cache") as caught:
        load_dataset(copy)
    assert "\n" not in str(caught.value) and list_entries(copy) == []


def test_datasets_of_one_name_share_a_folder(copy, tmp_path, decoded):
    other, cache = shutil.copytree(copy, tmp_path / "elsewhere" / "copy"), tmp_path / "cache"
    change_info(other, lambda info: info.update(splits={"train": "0:2", "eval": "2:6"}))
    for _ in range(2):
        assert [len(load_dataset(root, "train", cache)) for root in (copy, other)] == [4, 2]
    assert decoded == [copy, other] and not copy.with_name("copy.cache").exists()


def test_splits_in_any_order(copy):
    expected = decode_episodes(copy, read_info(copy), LAYOUT)
    change_info(copy, lambda info: info.update(splits={"train": "3:6", "eval": "1:3"}))
    splits, _ = load_demonstrations(copy)
    assert (splits["train"] == expected[3:]).all() and (splits["eval"] == expected[1:3]).all()
    assert (load_dataset(copy) == expected).all() and (load_dataset(copy, "eval") == expected[1:3]).all()


def test_the_hubs_snapshots_share_a_cache_beside_them(copy, tmp_path, decoded):
    place = tmp_path / "datasets--me--mine/snapshots/0123abcd"
    shutil.copytree(copy, place)
    load_dataset(place)
    assert [path.name for path in place.parent.iterdir()] == ["0123abcd"]
    assert (tmp_path / "datasets--me--mine/dynmap_rl.cache").is_dir()


def test_an_entry_may_be_larger_than_memory(tmp_path):
    size = 2 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    episodes = TensorDict({}).memmap_(tmp_path / "entry")
    episodes.make_memmap("action", (1, 1, size), dtype=torch.uint8)  # of holes, which take no place
    mapped = _map(tmp_path / "entry")
    assert mapped["action"].shape == (1, 1, size) and mapped["action"][0, 0, -1] == 0
    mapped["action"][0, 0, -1] = 7  # stays in the process
    assert _map(tmp_path / "entry")["action"][0, 0, -1] == 0


def test_splits_are_found_in_a_cache_of_another_order(copy, monkeypatch):
    load_demonstrations(copy)
    monkeypatch.setattr(demonstrations, "choose_splits", lambda *_: {"train": [2, 3], "eval": [0, 5]})
    parts, _ = load_demonstrations(copy)
    assert parts["train"]["episode"][:, 0].tolist() == [2, 3]
    assert parts["eval"]["episode"][:, 0].tolist() == [0, 5]
