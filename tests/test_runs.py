"""Run folders: nothing is lost by a kill, nothing damaged is read in silence."""

import importlib
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dynmap_rl import runs  # MODULE


@dataclass
class Settings:
    run: Path = Path("here")
    rate: float = 0.1
    names: tuple[str, ...] = ("a", "b")
    steps: int = 5


def test_json_round_trip_leaves_no_other_file(tmp_path):
    value = {"a": [1, 2.5, None], "b": {"c": "d"}}
    runs.write_json(tmp_path / "new" / "file.json", {})
    runs.write_json(tmp_path / "new" / "file.json", value)
    assert runs.read_json(tmp_path / "new" / "file.json") == value
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["file.json"]


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "file.json"
    runs.write_json(path, 1)
    with pytest.raises(TypeError):
        runs.write_json(path, object())
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        runs.write_json(path, 2)
    assert runs.read_json(path, int) == 1


def test_run_reopens_with_the_same_settings_only(tmp_path):
    settings = Settings()
    for _ in range(2):
        assert runs.open_run(tmp_path / "run", settings, ignore=("steps",)) == tmp_path / "run"
    runs.open_run(tmp_path / "run", replace(settings, steps=6), ignore=("steps",))
    with pytest.raises(ValueError, match=r"rate: 0\.1 there, 0\.2 here"):
        runs.open_run(tmp_path / "run", replace(settings, rate=0.2), ignore=("steps",))


def test_a_run_belongs_to_one_process(tmp_path):
    code = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from pathlib import Path; from dynmap_rl import runs; from test_runs import Settings\n"
        "runs.open_run(Path(sys.argv[1]), Settings()); print('open', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "run"), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "open\n"
        with pytest.raises(ValueError, match="another process works in .*; wait for it, or stop it"):
            runs.open_run(tmp_path / "run", Settings())
        other.kill()
    runs.open_run(tmp_path / "run", Settings())
    runs.open_run(tmp_path / "run", Settings())


def test_metrics_round_trip(tmp_path):
    assert runs.read_metrics(tmp_path) == []
    runs.append_metrics(tmp_path, 1, loss=torch.tensor(0.5), count=np.int64(3))
    runs.append_metrics(tmp_path, 2, loss=0.25, both=torch.tensor([1.0, 2.0]))
    expected = [{"step": 1, "loss": 0.5, "count": 3}, {"step": 2, "loss": 0.25, "both": [1.0, 2.0]}]
    assert runs.read_metrics(tmp_path) == expected


def test_metrics_line_cut_short_is_left_out(tmp_path):
    for step in (1, 2, 3):
        runs.append_metrics(tmp_path, step, loss=0.5)
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text()[:-8])
    assert [row["step"] for row in runs.read_metrics(tmp_path)] == [1, 2]
    runs.truncate_metrics(tmp_path, 1)
    runs.append_metrics(tmp_path, 2, loss=0.5)
    assert [row["step"] for row in runs.read_metrics(tmp_path)] == [1, 2]


def test_damaged_metrics_raise(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 2"):
        runs.read_metrics(tmp_path)


def test_training_state_restores_values_and_random_numbers(tmp_path):
    path = tmp_path / "checkpoint" / "state.pt"
    assert runs.load_training_state(path) is None
    runs.seed_everything(3)
    runs.save_training_state(path, weights={"w": torch.ones(2)}, step=7)
    drawn = torch.rand(4)
    state = runs.load_training_state(path)
    assert torch.equal(torch.rand(4), drawn)
    assert torch.equal(state["weights"]["w"], torch.ones(2))
    assert state["step"] == 7
    assert [p.name for p in path.parent.iterdir()] == ["state.pt"]


@pytest.mark.parametrize(
    "name, save, load",
    [
        ("config.json", lambda p: runs.write_json(p, {"a": 1}), runs.read_json),
        ("state.pt", lambda p: runs.save_training_state(p, step=1), runs.load_training_state),
    ],
)
@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"x" * len(b)])
def test_damaged_file_is_named(tmp_path, name, save, load, damage):
    path = tmp_path / name
    save(path)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=name):
        load(path)


def test_seeding_covers_every_generator():
    def draw():
        import random

        runs.seed_everything(11)
        return random.random(), np.random.rand(), torch.rand(1).item()

    assert draw() == draw()


STAGES = """
import os

def first(argument):
    folder, number = argument
    (folder / f"first_{number}").touch()

def second(argument):
    folder, number = argument
    assert (folder / f"first_{number}").exists()
    if number == 1:
        raise ValueError("this one fails")
    (folder / f"second_{number}").touch()

def third(argument):
    os._exit(1)
"""


@pytest.fixture
def stages(tmp_path, monkeypatch):
    """Of a module that other processes can import."""
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "some_stages.py").write_text(STAGES)
    monkeypatch.syspath_prepend(tmp_path / "stages")
    yield importlib.import_module("some_stages")
    del sys.modules["some_stages"]


@pytest.mark.parametrize("count", [1, 2])
def test_every_stage_follows_the_one_before(tmp_path, stages, count):
    (tmp_path / "out").mkdir()
    numbers = 0, 2, 3
    runs.run_processes([stages.first, stages.second], [(tmp_path / "out", n) for n in numbers], count)
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {f"{stage}_{n}" for stage in ("first", "second") for n in numbers}


@pytest.mark.parametrize("count", [1, 2])
def test_what_goes_wrong_in_a_process_is_raised(tmp_path, stages, count):
    with pytest.raises(ValueError, match="this one fails"):
        runs.run_processes([stages.first, stages.second], [(tmp_path, n) for n in range(4)], count)


def test_a_process_that_dies_is_an_error(tmp_path, stages):
    with pytest.raises(OSError, match="a process died"):
        runs.run_processes([stages.first, stages.third], [(tmp_path, 0), (tmp_path, 1)], 2)
