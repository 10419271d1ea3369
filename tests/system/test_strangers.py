"""Files and names from strangers: none of their names becomes a path that is written, and no pickle is opened."""

import json
import shutil

import pytest
import torch
from commands import run

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.experts.network import CHECKPOINTS
from dynmap_rl.runs.lookup import SHIPPED, find_run, load_actor, load_world_model_of, task_of_run
from recipes.robot import Config, default_folder


@pytest.fixture
def stranger(tmp_path):
    """Return a run folder of someone else, beside the working directory ``here``."""
    (tmp_path / "here").mkdir()
    return shutil.copytree(SHIPPED / "balance_reaching", tmp_path / "stranger")


def files(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("training", ["../../../out", "{}/out", ["joint"], None])
def test_a_run_that_names_a_path_gets_no_folder_there(stranger, training):
    """``recipes/generalize.py`` names its folder after how the world model was trained."""
    training = training.format(stranger.parent) if isinstance(training, str) else training
    source = {"task": "balance_reaching", "training": training}
    (stranger / "eval.json").write_text(json.dumps({"world_model": source}))
    before = files(stranger.parent)
    result = run(stranger.parent / "here", "generalize", "--pretrained", "../stranger")
    assert result.returncode == 2 and "holds no finished run" in result.stderr, result.stderr
    assert files(stranger.parent) == before


@pytest.mark.slow
@pytest.mark.parametrize("where", ["../stranger", "{}/stranger"])
def test_results_are_written_to_the_working_directory(stranger, where):
    """Their folder is named after the policy or the expert, wherever that lies."""
    shutil.copytree(CHECKPOINTS / "balance_reaching", stranger / "expert")
    where, before = where.format(stranger.parent), files(stranger.parent)
    for what in (["--policy", where], ["--expert", f"{where}/expert"]):
        result = run(stranger.parent / "here", "evaluate", *what, "--eval.episodes", "1")
        assert result.returncode == 0, result.stderr
    new = [path.split("/") for path in files(stranger.parent) - before]
    assert len(new) == 6 and all(parts[:3] == ["here", "runs", "evaluate"] for parts in new)
    assert all(len(parts) == 5 for parts in new), "each in one folder"


@pytest.mark.parametrize("dataset", ["..", "someone/..", "../data", "/data", "data/", "someone/data"])
def test_a_run_is_named_after_the_dataset_and_not_its_path(dataset):
    *parents, name, _ = default_folder(Config(dataset=dataset)).parts
    assert parents == ["runs", "robot"] and name not in ("", ".", "..")
    assert name == "data" or "data" not in dataset


def test_a_dataset_that_names_paths_is_written_to_one_folder(recording, tmp_path):
    place = tmp_path / "a/b"
    shutil.copytree(recording, place / "dataset")
    path = place / "dataset/meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["../../out"] = info["features"]["/out"] = info["features"]["action"]
    info |= {"data_path": "../../out", "video_path": "../../out", "repo_id": "../../out"}
    path.write_text(json.dumps(info))
    meta = json.loads((place / "dataset/meta/dynmap.json").read_text())
    text = json.dumps(meta | {"task": "../../out", "expert": "/out", "kind": "../out"})
    (place / "dataset/meta/dynmap.json").write_text(text)
    before = files(tmp_path)
    add_dynamics(place / "dataset", place / "new", state="dynamics.position", replace=True)
    written = {path.replace("/new/", "/dataset/") for path in files(tmp_path) - before}
    assert written == before | {"a/b/dataset/meta/dynamics.json"}


def test_only_json_and_safetensors_of_a_run_are_opened(stranger, monkeypatch):
    (stranger / "checkpoint").mkdir()
    (stranger / "checkpoint/world_model.pt").write_bytes(b"no training state")
    monkeypatch.setattr(torch, "load", None)
    folder = find_run(str(stranger))
    assert task_of_run(folder) == "balance_reaching"
    assert load_actor(folder).world_model.supervision == load_world_model_of(folder)[0].supervision
