"""Run folders: settings that must be the same, metrics and training states that survive a kill."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dynmap_rl.runs.folder import (
    append_metrics,
    load_training_state,
    open_run,
    read_metrics,
    save_training_state,
    truncate_metrics,
)
from dynmap_rl.utils.files import read_json, write_json


@dataclass(frozen=True)
class Group:
    updates: int = 5
    rate: float = 0.1


@dataclass(frozen=True)
class Settings:
    run: Path = Path("here")
    names: tuple[str, ...] = ("a", "b")
    threads: int = 2
    world_model: Group = Group()


def test_a_run_reopens_with_the_same_settings_only(tmp_path):
    settings = Settings()
    for changed in (settings, settings, replace(settings, threads=6)):
        assert open_run(tmp_path / "run", changed, ignore=("threads",)) == tmp_path / "run"
        append_metrics(tmp_path / "run", 1)
    changed = replace(settings, world_model=Group(updates=6), names=("a",))
    with pytest.raises(ValueError, match=r"names: .*, world_model\.updates: 5 there, 6 here\)"):
        open_run(tmp_path / "run", changed, ignore=("threads",))
    more = replace(settings, world_model=Group(updates=6))
    for name in ("world_model.updates", "world_model"):
        open_run(tmp_path / "run", more, ignore=(name,))
    named = replace(settings, run=f"{settings.run}/", names=("a", "b"))
    open_run(
        tmp_path / "run", replace(named, world_model=Group(updates=5))
    )  # a slash at the end says nothing
    assert read_json(tmp_path / "run/config.json")["world_model"] == {"updates": 5, "rate": 0.1}


def test_a_run_that_has_not_begun_to_train_may_get_other_settings(tmp_path):
    open_run(tmp_path, Settings())
    for name in ("dataset.json", "world_model.json"):
        write_json(tmp_path / name, {"sha256": "of others"})
    truncate_metrics(tmp_path, 0)  # a training begins, and fails in its first update
    open_run(tmp_path, Settings(names=("a",)))
    assert read_json(tmp_path / "config.json")["names"] == ["a"]
    assert {path.name for path in tmp_path.iterdir()} == {".lock", "config.json"}


def test_a_folder_that_is_no_run_is_left_alone(tmp_path):
    append_metrics(tmp_path, 1, loss=0.5)
    write_json(tmp_path / "eval.json", {"of": "somebody"})
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="run or a new folder.*--run"):
        open_run(tmp_path, Settings())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


def test_a_file_of_a_runs_inputs_in_a_folder_without_settings_is_kept(tmp_path):
    write_json(tmp_path / "dataset.json", {"of": "somebody"})
    open_run(tmp_path, Settings())
    assert read_json(tmp_path / "dataset.json") == {"of": "somebody"}


def test_a_hidden_file_of_a_file_manager_is_no_content(tmp_path):
    (tmp_path / ".DS_Store").write_bytes(b"")
    open_run(tmp_path, Settings())


def test_a_run_that_is_older_than_a_setting_has_its_default(tmp_path):
    open_run(tmp_path, Settings())
    append_metrics(tmp_path, 1)
    stored = read_json(tmp_path / "config.json")
    del stored["world_model"]["rate"]
    write_json(tmp_path / "config.json", stored)
    open_run(tmp_path, Settings())
    with pytest.raises(ValueError, match=r"world_model\.rate: 0\.1 there, 0\.2 here"):
        open_run(tmp_path, Settings(world_model=Group(rate=0.2)))


def test_a_run_of_the_first_release_is_refused(tmp_path):
    """Its settings were flat."""
    append_metrics(tmp_path, 1)
    write_json(tmp_path / "config.json", {"run": "here", "updates": 5, "rate": 0.1})
    with pytest.raises(ValueError, match="another release.*--run"):
        open_run(tmp_path, Settings())


def test_metrics_round_trip(tmp_path):
    assert read_metrics(tmp_path) == []
    append_metrics(tmp_path, 1, loss=torch.tensor(0.5), count=np.int64(3))
    append_metrics(tmp_path, 2, loss=0.25, unknown=math.nan, endless=math.inf, both=torch.tensor([1.0, 2.0]))
    expected = [{"step": 1, "loss": 0.5, "count": 3}, {"step": 2, "loss": 0.25, "both": [1.0, 2.0]}]
    assert read_metrics(tmp_path) == expected


def test_a_metrics_line_cut_short_is_left_out(tmp_path):
    for step in (1, 2, 3):
        append_metrics(tmp_path, step, loss=0.5)
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text()[:-8])
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2]
    truncate_metrics(tmp_path, 1)
    append_metrics(tmp_path, 2, loss=0.5)
    assert [row["step"] for row in read_metrics(tmp_path)] == [1, 2]


def test_damaged_metrics_raise(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl, line 2"):
        read_metrics(tmp_path)


def test_a_training_state_restores_values_and_random_numbers(tmp_path):
    path = tmp_path / "checkpoint/state.pt"
    assert load_training_state(path) is None
    torch.manual_seed(3)
    save_training_state(path, weights={"w": torch.ones(2)}, step=7)
    drawn = torch.rand(4)
    state = load_training_state(path)
    assert torch.equal(torch.rand(4), drawn)
    assert torch.equal(state["weights"]["w"], torch.ones(2))
    assert state["step"] == 7
    assert [path.name for path in path.parent.iterdir()] == ["state.pt"]


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"x" * len(b)])
def test_a_damaged_training_state_is_named(tmp_path, damage):
    path = tmp_path / "state.pt"
    save_training_state(path, step=1)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"state\.pt"):
        load_training_state(path)


def test_a_training_state_that_cannot_be_opened_is_not_called_damaged(tmp_path):
    """Advice to delete it would cost the training."""
    (tmp_path / "state.pt").mkdir()
    with pytest.raises(OSError):
        load_training_state(tmp_path / "state.pt")
