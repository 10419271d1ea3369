"""Runs by name and folder: what they are of, and their actors."""

import shutil

import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.runs.lookup import SHIPPED, find_run, load_actor, load_world_model_of, task_of_run
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.weights import fingerprint

OURS = "balance_reaching"


@pytest.fixture
def run(tmp_path):
    return shutil.copytree(SHIPPED / OURS, tmp_path / "run")


def test_names_and_folders(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_run(OURS) == SHIPPED / OURS
    assert find_run(str(run)) == find_run(run) == run
    assert find_run("runs/none").as_posix() == "runs/none", "a path of ours is no id of the hub"


def test_the_hub_that_cannot_be_reached_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match="someone/policy"):
        find_run("someone/policy")


def test_the_world_model_of_a_run_with_its_origin(run):
    model, source = load_world_model_of(run)
    same, same_source = load_world_model_of(run / "world_model")
    assert fingerprint(model) == fingerprint(same)
    assert source == same_source == {"task": OURS, "training": "decoupled"}
    with pytest.raises(ValueError, match="no finished run"):
        load_world_model_of(run / "seed_0")
    named = run.rename(run.with_name("seed_7"))
    assert load_world_model_of(named)[1] == source


def test_the_world_model_of_one_seed_of_a_joint_run(run):
    write_json(run / "eval.json", {"world_model": {"task": OURS, "training": "joint"}})
    (run / "world_model").rename(run / "seed_0/world_model")
    for folder in (run / "seed_0", run / "seed_0/world_model"):
        model, source = load_world_model_of(folder)
        assert source == {"task": OURS, "training": "joint"} and model.supervision


def test_a_joint_run_has_a_world_model_for_each_seed(run):
    before = fingerprint(load_actor(run).world_model)
    own = shutil.copytree(run / "world_model", run / "seed_0/world_model")
    weights = own / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    assert fingerprint(load_actor(run).world_model) != before
    with pytest.raises(ValueError, match="seed_3"):
        load_actor(run, seed=3)


def test_tasks_of_runs(run):
    assert task_of_run(run) == OURS
    write_json(run / "config.json", {"dataset": "datasets/mine"})
    with pytest.raises(ValueError, match="datasets/mine"):
        task_of_run(run)
    write_json(run / "config.json", {"task": 1})
    with pytest.raises(ValueError, match=r"config\.json: task must be a name, got 1"):
        task_of_run(run)
    (run / "config.json").unlink()
    assert task_of_run(run) is None


def test_a_policy_of_the_first_release_still_acts(run):
    """Its settings were flat; the weights are the same."""
    write_json(
        run / "config.json", {"task": OURS, "updates": 2500, "policy": "recurrent", "world_model": None}
    )
    assert task_of_run(run) == OURS
    actor = load_actor(run)
    td = TensorDict({"pixels": torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "goal": torch.zeros(2, 2)}, [2])
    td["is_init"] = torch.ones(2, 1, dtype=torch.bool)
    assert load_actor(OURS)(td.clone())["action"].equal(actor(td)["action"])
