"""The dataset that a recipe trains on."""

import shutil
from pathlib import Path

import pytest

from dynmap_rl.envs.tasks import get_task
from dynmap_rl.training import dataset
from dynmap_rl.training.dataset import check_dataset, find_or_record
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
    monkeypatch.setattr(dataset, "record_dataset", lambda *arguments: arguments)
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
