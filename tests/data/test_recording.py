"""Recordings: what is kept, what is known of it, and how an interrupted one goes on."""

import json
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.data.recording.shards import normalization_constants
from dynmap_rl.data.recording.shards import record_dataset
from dynmap_rl.data import recording as module  # MODULE
from dynmap_rl.data.format.writing import FEATURES
from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import VELOCITY_LIMIT
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.utils.files import write_json

DYNAMICS = ("position", "velocity", "acceleration")


def files(root) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("name", TASKS)
def test_metadata_tells_how_every_episode_was_made(recordings, name):
    recording, task = recordings(name), get_task(name)
    meta = load_meta(recording)
    assert (meta["format"], meta["task"], meta["expert"]) == (2, name, name)
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
    assert max(seeds["train"]) < 100_000_000 <= min(seeds["eval"])
    disturbed = load_dataset(recording)["disturbed"]
    for row, marks in zip(rows, disturbed, strict=True):
        steps = {t for start, end in row["pushes"] for t in range(start, end)}
        assert set(marks.flatten().nonzero().flatten().tolist()) == steps


def test_lerobot_reads_the_columns_and_splits(recording):
    info = json.loads((recording / "meta" / "info.json").read_text())
    assert info["splits"] == {"train": "0:4", "eval": "4:6"}
    assert (info["fps"], info["robot_type"], info["total_episodes"]) == (20, "dynmap_cart", 6)
    for name, feature in FEATURES.items():
        stored = info["features"][name]
        assert (stored["dtype"], tuple(stored["shape"]), stored["names"]) == tuple(feature.values())


def test_statistics_are_those_of_float64(recording):
    stats = json.loads((recording / "meta" / "stats.json").read_text())
    episodes = load_dataset(recording).double()
    columns = {"action": "action", "observation.state": "agent_pos"}
    columns |= {f"dynamics.{name}": ("dynamics", name) for name in DYNAMICS}
    for name, key in columns.items():
        values = episodes[key].flatten(0, 1).numpy()
        np.testing.assert_allclose(stats[name]["mean"], values.mean(0), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(stats[name]["std"], values.std(0), rtol=1e-5, atol=1e-7)
        np.testing.assert_allclose(stats[name]["min"], values.min(0))
        np.testing.assert_allclose(stats[name]["max"], values.max(0))
        low, high = np.quantile(values, [0.49, 0.51], axis=0)
        bin_width = (values.max(0) - values.min(0)) / 5000  # of LeRobot's histograms
        assert (low - bin_width <= stats[name]["q50"]).all()
        assert (stats[name]["q50"] <= high + bin_width).all()
    goals = episodes["goal"][:, 0]
    assert stats["observation.state"]["q01"][3] < goals[:, 0].min() + 1e-3  # not the episodes' mean


def test_statistics_of_the_episodes_are_those_of_float64(recording):
    import pandas

    table = pandas.concat(
        pandas.read_parquet(p) for p in (recording / "meta" / "episodes").rglob("*.parquet")
    )
    goals = load_dataset(recording)["goal"][:, 0].numpy()
    std = np.stack(table["stats/observation.state/std"])
    assert (std[:, 3:] >= 0).all() and (std[:, 3:] < 1e-7).all()  # constant in an episode; float32 gives 1e-4
    np.testing.assert_allclose(np.stack(table["stats/observation.state/mean"])[:, 3:], goals, rtol=1e-9)


def test_normalization_is_natural_and_widens_only_where_needed(recording):
    episodes = load_dataset(recording, "train")
    stored = load_meta(recording)["normalization"]
    assert stored == normalization_constants(episodes)
    assert stored["goal"] == {"low": [0.0, 0.0], "high": [1.0, 1.0]}
    assert stored["position"]["low"][:3] == [0.0, 0.0, -0.5]
    np.testing.assert_allclose(stored["velocity"]["high"][:3], VELOCITY_LIMIT)
    fast = episodes.clone()
    fast["dynamics", "velocity"][..., 3] = -2.0
    widened = normalization_constants(fast)["velocity"]
    assert (widened["low"][3], widened["high"][3]) == (-2.0, 2.0)
    assert widened["high"][:3] == stored["velocity"]["high"][:3]
    still = episodes.apply(torch.zeros_like)
    for constants in normalization_constants(still).values():
        assert (np.array(constants["low"]) < np.array(constants["high"])).all()


KILLED = """
from dynmap_rl.data import record_dataset, recording
if __name__ == "__main__":
    recording.SHARD_EPISODES = 2
    record_dataset({root!r}, episodes=4, eval_episodes=2, workers=2)
"""


@pytest.mark.slow
def test_a_killed_recording_goes_on_to_the_same_dataset(recording, tmp_path, monkeypatch):
    root, parts, script = tmp_path / "killed", tmp_path / "killed.parts", tmp_path / "record.py"
    script.write_text(KILLED.format(root=str(root)))
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.DEVNULL)
    while not any(parts.glob("*_000?")) and process.poll() is None:
        time.sleep(0.01)
    workers = children_of(process.pid)
    process.send_signal(signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 10
    while any(is_running(pid) for pid in workers):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.05)
    assert not root.exists()
    finished = sorted(p.name for p in parts.glob("*_000?"))
    assert finished
    for name in finished:
        assert load_dataset(parts / name).shape == (2, 120)
    (parts / "train_0001.tmp").mkdir(exist_ok=True)
    (parts / "train_0001.tmp" / "rest").write_text("of a shard that was being written")

    again, record_shard = [], module._record_shard
    monkeypatch.setattr(module, "SHARD_EPISODES", 2)
    monkeypatch.setattr(
        module, "_record_shard", lambda shard: (again.append(shard.folder.name), record_shard(shard))
    )
    assert record_dataset(root, episodes=4, eval_episodes=2, workers=1) == root
    assert sorted(again + finished) == ["eval_0000", "train_0000", "train_0001"]
    assert not parts.exists()
    assert files(root) == files(recording)


def children_of(pid: int) -> list[int]:
    return [
        int(task)
        for path in Path(f"/proc/{pid}/task").glob("*/children")
        for task in path.read_text().split()
    ]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_complete_recording_is_left_as_it_is(recording):
    before = {p: p.stat().st_mtime_ns for p in recording.rglob("*")}
    assert record_dataset(recording, episodes=4, eval_episodes=2) == recording
    assert {p: p.stat().st_mtime_ns for p in recording.rglob("*")} == before
    assert [p.name for p in recording.parent.iterdir()] == [recording.name]


def test_a_recording_of_another_format_is_refused(recording, tmp_path):
    root = shutil.copytree(recording, tmp_path / "old")
    write_json(root / module.META, load_meta(root) | {"format": 1})
    with pytest.raises(ValueError, match=r"another recording \(format: 1 there, 2 here\)"):
        record_dataset(root, episodes=4, eval_episodes=2)


def test_exploration_keeps_every_episode_and_has_scenes_of_its_own(tmp_path):
    root = record_dataset(
        tmp_path / "exploration", kind="exploration", episodes=2, eval_episodes=1, workers=1
    )
    rows = load_meta(root)["episodes"]
    assert [row["scene_seed"] for row in rows] == [400_000_000, 400_000_001, 450_000_000]
    assert all(row["detours"] == 3 and row["noise"] > 0 for row in rows)
    assert load_dataset(root, "eval").shape == (1, 120)


def test_failures_are_replaced_by_the_next_candidates(tmp_path, monkeypatch):
    rolled = []

    def roll_out(task, plans, expert):
        assert (task, expert) == ("balance_reaching", "bin_dropping")
        rolled.append([plan.scene_seed for plan in plans])
        success = torch.tensor([plan.scene_seed % 3 == 0 for plan in plans])
        flags = torch.zeros(len(plans), 120, 1, dtype=torch.bool)
        flags[:, -1, 0] = success
        return TensorDict({("next", "is_success"): flags}, [len(plans), 120])

    monkeypatch.setattr(module, "roll_out", roll_out)
    names = {"task": "balance_reaching", "expert": "bin_dropping", "kind": "demonstrations", "split": "train"}
    shard = module.Shard(tmp_path, **names, number=2, count=5)
    checkpoints = list_checkpoints("bin_dropping")
    plans, episodes = module._roll_out_shard(shard)
    assert [plan.scene_seed for plan in plans] == [501, 504, 507, 510, 513]
    assert [plan.checkpoint for plan in plans] == [checkpoints[i % 5] for i in (1, 4, 2, 0, 3)]
    assert episodes.shape == (5, 120)
    assert [seed for batch in rolled for seed in batch] == list(range(500, 500 + sum(map(len, rolled))))
    monkeypatch.setattr(module, "CANDIDATES_PER_SHARD", 10)
    with pytest.raises(ValueError, match="train a better expert"):
        module._roll_out_shard(shard)


def test_shards_never_share_a_scene(tmp_path):
    settings = {"task": "balance_reaching", "expert": "balance_reaching", "kind": "demonstrations"}
    settings |= {"episodes": 60, "eval_episodes": 30}
    shards = module._plan_shards(tmp_path, settings)
    assert [s.count for s in shards] == [25, 25, 10, 25, 5]
    seeds = [
        p.scene_seed for s in shards for p in module._plan(s, s.number * module.CANDIDATES_PER_SHARD, 250)
    ]
    assert len(set(seeds)) == len(seeds)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 5}, "episodes: 4 there, 5 here"),
        ({"kind": "exploration"}, "kind: demonstrations there"),
        ({"kind": "something"}, "unknown kind"),
        ({"task": "something"}, "unknown task"),
        ({"eval_episodes": 0}, "at least one episode"),
        ({"expert": "bin_dropping"}, "expert: balance_reaching there, bin_dropping here"),
        ({"expert": "something"}, "no expert at something"),
    ],
)
def test_other_settings_are_refused(recording, changes, message):
    with pytest.raises(ValueError, match=message):
        record_dataset(recording, **{"episodes": 4, "eval_episodes": 2, **changes})


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("do not lose me")
    with pytest.raises(ValueError, match="no dataset of ours"):
        record_dataset(tmp_path)
    with pytest.raises(OSError, match="may the folder be written"):
        record_dataset(tmp_path / "thesis.tex" / "dataset")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "exploration"}, "kind: exploration there, demonstrations here"),
        ({"format": 1}, "format: 1 there, 2 here"),
    ],
)
def test_unfinished_shards_of_other_settings_are_refused(tmp_path, changes, message):
    settings = {"task": "balance_reaching", "expert": "balance_reaching", "kind": "demonstrations"}
    settings |= {"episodes": 4, "eval_episodes": 2, "format": 2, **changes}
    write_json(tmp_path / "d.parts" / "settings.json", settings)
    with pytest.raises(ValueError, match=rf"another recording \({message}\)"):
        record_dataset(tmp_path / "d", episodes=4, eval_episodes=2)


def test_two_recordings_of_one_folder_are_refused(tmp_path):
    (tmp_path / "d.parts").mkdir()
    with FileLock(tmp_path / "d.parts" / ".lock"), pytest.raises(ValueError, match="another process"):
        record_dataset(tmp_path / "d", episodes=1, eval_episodes=1)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), BrokenProcessPool("died")])
def test_a_full_disk_or_a_lost_worker_is_one_clear_error(tmp_path, monkeypatch, error):
    def fail(*args):
        raise error

    monkeypatch.setattr(module, "_record_shard", fail)
    with pytest.raises(OSError, match=r"The same call goes on|the same call goes on"):
        record_dataset(tmp_path / "d", episodes=1, eval_episodes=1, workers=1)
