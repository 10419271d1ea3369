"""Recordings: folders, settings, and how an interrupted recording resumes."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

from dynmap_rl.data.demonstrations import FORMAT, META, load_dataset, load_meta
from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.data.recording import record as module
from dynmap_rl.data.recording.record import record_dataset
from dynmap_rl.utils.files import write_json


def files(root) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


KILLED = """
from dynmap_rl.data.recording import record
if __name__ == "__main__":
    record.SHARD_EPISODES = 2
    record.record_dataset({root!r}, episodes=4, eval_episodes=2, workers=2)
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
    deadline = time.monotonic() + 60  # s; the machine may be busy
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

    again, record_shard = [], module.record_shard
    monkeypatch.setattr(module, "SHARD_EPISODES", 2)
    monkeypatch.setattr(
        module, "record_shard", lambda shard: (again.append(shard.folder.name), record_shard(shard))
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
    beside = sorted(recording.parent.iterdir())
    assert record_dataset(recording, episodes=4, eval_episodes=2) == recording
    assert {p: p.stat().st_mtime_ns for p in recording.rglob("*")} == before
    assert sorted(recording.parent.iterdir()) == beside


@pytest.mark.slow
def test_ray_records_the_same_bits(ray, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SHARD_EPISODES", 2)
    root = record_dataset(tmp_path / "recording", episodes=4, eval_episodes=2, launcher="ray")
    assert files(root) == files(recording)


def test_a_recording_of_the_first_release_is_refused(recording, tmp_path):
    root = shutil.copytree(recording, tmp_path / "old")
    write_json(root / META, load_meta(root) | {"format": 2})
    with pytest.raises(ValueError, match=r"format 2; .*recipes/collect\.py"):
        record_dataset(root, episodes=4, eval_episodes=2)


@pytest.mark.slow
def test_exploration_keeps_every_episode_and_has_scenes_of_its_own(tmp_path):
    root = record_dataset(
        tmp_path / "exploration", kind="exploration", episodes=2, eval_episodes=1, workers=1
    )
    rows, episodes = load_meta(root)["episodes"], load_dataset(root)
    assert [row["scene_seed"] for row in rows] == [400_000_000, 400_000_001, 450_000_000]
    assert all(row["detours"] == 3 and row["noise"] > 0 for row in rows)
    assert episodes["next", "done"].sum() == 3, "one trajectory each, also after a drop"
    assert not episodes["disturbed"].any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episodes": 5}, "episodes 4 instead of 5"),
        ({"kind": "exploration"}, "kind demonstrations"),
        ({"kind": "something"}, "kind .*something"),
        ({"task": "something"}, "something"),
        ({"eval_episodes": 0}, "eval_episodes .*0"),
        ({"expert": "bin_dropping"}, "expert balance_reaching instead of bin_dropping"),
        ({"expert": "something"}, "something"),
    ],
)
def test_other_settings_are_refused(recording, changes, message):
    with pytest.raises(ValueError, match=message):
        record_dataset(recording, **{"episodes": 4, "eval_episodes": 2, **changes})


def test_a_folder_with_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("do not lose me")
    with pytest.raises(ValueError, match="something else"):
        record_dataset(tmp_path)
    with pytest.raises(OSError, match="may the folder be written"):
        record_dataset(tmp_path / "thesis.tex" / "dataset")


def test_a_recording_with_derived_dynamics_is_not_taken_for_the_simulators(recording, tmp_path):
    add_dynamics(recording, tmp_path / "derived", replace=True, columns=range(3))
    settings = {"episodes": 4, "eval_episodes": 2}
    assert record_dataset(recording, **settings) == recording
    with pytest.raises(ValueError, match="derived dynamics"):
        record_dataset(tmp_path / "derived", **settings)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "exploration"}, "kind exploration instead of demonstrations"),
        ({"format": 2}, "format 2 instead of 4"),
    ],
)
def test_unfinished_shards_of_other_settings_are_refused(tmp_path, changes, message):
    settings = {"task": "balance_reaching", "expert": "balance_reaching", "kind": "demonstrations"}
    settings |= {"episodes": 4, "eval_episodes": 2, "format": FORMAT, **changes}
    write_json(tmp_path / "d.parts" / "settings.json", settings)
    (tmp_path / "d.parts" / "train_0000").mkdir()
    with pytest.raises(ValueError, match=rf"d.parts holds another recording \({message}\)"):
        record_dataset(tmp_path / "d", episodes=4, eval_episodes=2)


def test_episodes_that_a_person_has_recorded_are_kept(tmp_path):
    write_json(tmp_path / "d.parts" / "settings.json", {"task": "balance_reaching", "kind": "human"})
    (tmp_path / "d.parts" / "0000").mkdir()
    with pytest.raises(ValueError, match="d.parts holds another recording"):
        record_dataset(tmp_path / "d", episodes=1, eval_episodes=1)
    assert (tmp_path / "d.parts" / "0000").exists()


def test_two_recordings_of_one_folder_are_refused(tmp_path):
    (tmp_path / "d.parts").mkdir()
    with FileLock(tmp_path / "d.parts" / ".lock"), pytest.raises(ValueError, match="another process"):
        record_dataset(tmp_path / "d", episodes=1, eval_episodes=1)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ChildProcessError("died")])
def test_a_full_disk_or_a_lost_worker_is_one_clear_error(tmp_path, monkeypatch, error):
    def fail(*args):
        raise error

    monkeypatch.setattr(module, "record_shard", fail)
    with pytest.raises(OSError, match="[Tt]he same call|repeat the call"):
        record_dataset(tmp_path / "d", episodes=1, eval_episodes=1, workers=1)


def test_a_mistake_before_the_first_episode_leaves_no_folder(tmp_path, monkeypatch):
    def fail(*_):
        raise ValueError("a mistake")

    monkeypatch.setattr(module, "_run_shards", fail)
    with pytest.raises(ValueError, match="a mistake"):
        record_dataset(tmp_path / "d", "balance_reaching", episodes=2, eval_episodes=1, workers=1)
    assert not any(tmp_path.iterdir())


def test_an_expert_that_reads_other_states_is_refused(tmp_path):
    """The states of tasks 2 and 3 have the same number of entries."""
    for task, expert in (("bin_dropping", "balance_reaching_obstacle"), ("balance_reaching", "bin_dropping")):
        with pytest.raises(ValueError, match=f"expert {expert} reads states of {expert}, which {task}"):
            record_dataset(tmp_path / "d", task, "exploration", 2, 1, expert=expert)
    assert not list(tmp_path.iterdir())


def test_an_expert_of_task_1_is_recorded_in_the_scenes_of_the_others(tmp_path):
    settings = {"episodes": 1, "eval_episodes": 1, "workers": 1, "expert": "balance_reaching"}
    root = record_dataset(tmp_path / "d", "bin_dropping", "exploration", **settings)
    assert load_dataset(root).shape == (2, 120)
