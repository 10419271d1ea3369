"""Shards: which episodes they keep, and what is stored beside the columns."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import FORMAT, META, load_dataset, load_meta
from dynmap_rl.data.recording import shards as module
from dynmap_rl.data.recording.record import _plan_shards
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.utils.files import read_json


@pytest.mark.parametrize("name", ["balance_reaching", "bin_dropping"])
def test_metadata_tells_how_every_episode_was_made(recordings, name):
    recording, task = recordings(name), get_task(name)
    meta = load_meta(recording)
    assert (meta["format"], meta["task"], meta["expert"]) == (FORMAT, name, name)
    assert meta["kind"] == "demonstrations"
    assert meta["splits"] == {"train": [0, 4], "eval": [4, 6]}
    rows = meta["episodes"]
    assert [row["episode_index"] for row in rows] == list(range(6))
    assert [row["split"] for row in rows] == ["train"] * 4 + ["eval"] * 2
    assert all(row["success"] and row["checkpoint"] in list_checkpoints(name) for row in rows)
    assert all(row["dropped"] is (name == "bin_dropping") for row in rows)
    for row in rows:
        scene = task.sample_scene(np.random.default_rng(row["scene_seed"]))
        assert json.loads(json.dumps(scene.to_dict())) == row["scene"]
    seeds = {split: {r["scene_seed"] for r in rows if r["split"] == split} for split in ("train", "eval")}
    assert len(seeds["train"]) == 4 and len(seeds["eval"]) == 2
    last = {seed // module.CANDIDATES_PER_SHARD: seed for seed in sorted(seeds["train"] | seeds["eval"])}
    assert meta["rejected"] == sum(seed % module.CANDIDATES_PER_SHARD + 1 for seed in last.values()) - 6
    assert max(seeds["train"]) < 100_000_000 <= min(seeds["eval"])
    disturbed = load_dataset(recording)["disturbed"]
    for row, marks in zip(rows, disturbed, strict=True):
        steps = {t for start, end in row["pushes"] for t in range(start, end)}
        assert set(marks.flatten().nonzero().flatten().tolist()) == steps


def test_failures_are_replaced_by_the_next_candidates(tmp_path, monkeypatch):
    rolled = []

    def run_plans(task, plans, expert):
        assert (task, expert) == ("balance_reaching", "bin_dropping")
        rolled.append([plan.scene_seed for plan in plans])
        success = torch.tensor([plan.scene_seed % 3 == 0 for plan in plans])
        flags = torch.zeros(len(plans), 120, 1, dtype=torch.bool)
        flags[:, -1, 0] = success
        return TensorDict({("next", "is_success"): flags}, [len(plans), 120])

    monkeypatch.setattr(module, "run_plans", run_plans)
    names = {"task": "balance_reaching", "expert": "bin_dropping", "kind": "demonstrations", "split": "train"}
    shard = module.Shard(tmp_path, **names, number=2, count=5)
    checkpoints = list_checkpoints("bin_dropping")
    plans, episodes = module._run_shard(shard)
    assert [plan.scene_seed for plan in plans] == [501, 504, 507, 510, 513]
    assert [plan.checkpoint for plan in plans] == [
        checkpoints[i // 3 % len(checkpoints)] for i in (501, 504, 507, 510, 513)
    ]
    assert episodes.shape == (5, 120)
    assert [seed for batch in rolled for seed in batch] == list(range(500, 500 + sum(map(len, rolled))))
    monkeypatch.setattr(module, "CANDIDATES_PER_SHARD", 10)
    for scripted, advice in ((False, "train a better expert"), (True, "improve its demonstrator")):
        monkeypatch.setattr(
            module, "get_task", lambda name, scripted=scripted: SimpleNamespace(has_demonstrator=scripted)
        )
        with pytest.raises(ValueError, match=advice):
            module._run_shard(shard)


def test_constants_are_those_of_the_training_episodes(tmp_path, monkeypatch):
    names = {"task": "balance_reaching", "expert": "balance_reaching", "kind": "exploration"}
    shards = [module.Shard(tmp_path, **names, split=s, number=0, count=2) for s in ("train", "eval")]
    episodes = TensorDict({"number": torch.arange(4)[:, None].expand(4, 120)}, [4, 120])
    monkeypatch.setattr(module, "read_json", lambda *_: [{}, {}])
    monkeypatch.setattr(module, "merge_datasets", lambda *_: episodes)
    monkeypatch.setattr(module, "normalization_constants", lambda part: part["number"][:, 0].tolist())
    module.merge_shards(shards, tmp_path, names | {"episodes": 2})
    assert read_json(tmp_path / META)["normalization"] == [0, 1]


def test_shards_never_share_a_scene(tmp_path):
    settings = {"task": "balance_reaching", "expert": "balance_reaching", "kind": "demonstrations"}
    settings |= {"episodes": 60, "eval_episodes": 30}
    shards = _plan_shards(tmp_path, settings)
    assert [s.count for s in shards] == [25, 25, 10, 25, 5]
    seeds = [
        p.scene_seed for s in shards for p in module._plan(s, s.number * module.CANDIDATES_PER_SHARD, 250)
    ]
    assert len(set(seeds)) == len(seeds)
