"""The dataset that a recipe trains on."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from dynmap_rl.data.settings import Augmentation
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.training import dataset
from dynmap_rl.training.dataset import check_dataset, check_start, choose_augmentation, find_or_record
from dynmap_rl.utils.files import read_json, write_json

TASK = "balance_reaching"


def test_an_existing_dataset_is_taken(recording, tmp_path, monkeypatch):
    """It may have any number of episodes, but must hold demonstrations of the task."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dataset, "record_dataset", None)
    assert find_or_record(TASK, str(recording)) == str(recording)
    shutil.copytree(recording, f"datasets/{TASK}")
    assert find_or_record(TASK) == Path("datasets") / TASK
    meta = Path("datasets") / TASK / "meta/dynmap.json"
    for changes in ({"kind": "exploration"}, {"task": "bin_dropping"}):
        write_json(meta, read_json(recording / "meta/dynmap.json") | changes)
        with pytest.raises(ValueError, match=f"datasets/{TASK}.*{next(iter(changes.values()))}"):
            find_or_record(TASK)


def test_a_missing_default_dataset_is_recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(dataset, "record_dataset", lambda *arguments, workers: arguments)
    assert find_or_record(TASK) == (Path("datasets") / TASK, TASK)
    with pytest.raises(ValueError, match="datasets/none"):
        find_or_record(TASK, "datasets/none")


def test_a_dataset_of_another_task_is_refused(recording):
    check_dataset(recording, TASK)
    with pytest.raises(ValueError, match="bin_dropping.*balance_reaching"):
        check_dataset(recording, "bin_dropping")


def test_a_dataset_of_other_cameras_is_refused(recording, tmp_path):
    """Otherwise a policy would be trained on other frames than it is evaluated on."""
    shutil.copytree(recording, tmp_path / "recording")
    path = tmp_path / "recording/meta/dynmap.json"
    layout = get_task(TASK).layout.to_dict() | {"cameras": ["side"]}
    write_json(path, read_json(path) | {"layout": layout})
    with pytest.raises(ValueError, match="cameras.*side.*front"):
        check_dataset(tmp_path / "recording", TASK)


def test_a_recording_begins_as_the_task_does_now(recording, tmp_path, monkeypatch):
    check_start(recording, TASK)
    shutil.copytree(recording, tmp_path / "recording")
    path = tmp_path / "recording/meta/dynmap.json"
    meta = read_json(path)
    first, second = meta["episodes"][:2]
    write_json(path, meta | {"episodes": [first | {"scene_seed": second["scene_seed"]}, second]})
    with pytest.raises(ValueError, match="first state of .*recording"):
        find_or_record(TASK, tmp_path / "recording")
    unnamed = {key: value for key, value in first.items() if key != "scene_seed"}
    write_json(path, meta | {"episodes": [unnamed, second]})
    check_start(tmp_path / "recording", TASK)
    task = get_task(TASK)
    draw = task.make_renderer()
    monkeypatch.setattr(type(task), "make_renderer", lambda self: lambda world: np.roll(draw(world), 1, 1))
    with pytest.raises(ValueError, match="first frame of"):
        check_start(recording, TASK)


def test_a_recording_without_its_data_is_refused(recording, tmp_path):
    root = shutil.copytree(recording, tmp_path / "recording")
    shutil.rmtree(root / "data")
    with pytest.raises(ValueError, match="recording must have"):
        find_or_record(TASK, root)


def test_a_run_keeps_a_hash_of_its_data(recording, tmp_path):
    root, run = shutil.copytree(recording, tmp_path / "demonstrations"), tmp_path / "run"
    for _ in range(2):
        assert find_or_record("balance_reaching", root, run) == root
    info = root / "meta/info.json"
    info.write_text(info.read_text() + " ")
    with pytest.raises(ValueError, match="other data than"):
        find_or_record("balance_reaching", root, run)


def test_a_shift_without_effect_is_refused():
    task = get_task("bin_dropping")
    assert choose_augmentation(task, Augmentation(), imitated=True).max_shift == 0
    assert choose_augmentation(task, Augmentation(max_shift=3)).max_shift == 3
    with pytest.raises(ValueError, match="max_shift has no effect with bin_dropping"):
        choose_augmentation(task, Augmentation(max_shift=3), imitated=True)
