"""Metrics as lines of JSON, and where else a user wants them."""

import sys
from types import SimpleNamespace

import pytest
import torch
from commands import run

from dynmap_rl import loggers
from dynmap_rl.loggers import check_logger, log_metrics
from dynmap_rl.runs import read_metrics


@pytest.fixture(autouse=True)
def closed():
    yield
    loggers._open.cache_clear()


def test_without_a_logger_there_are_lines_of_json(tmp_path):
    log_metrics(tmp_path, 3, loss=torch.tensor(0.5))
    assert read_metrics(tmp_path) == [{"step": 3, "loss": 0.5}]
    assert [path.name for path in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_tensorboard_gets_the_same_numbers(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for step in (1, 2):
        log_metrics(tmp_path, step, "tensorboard", loss=1 / step, error=torch.tensor(2.0))
    loggers._open("tensorboard", tmp_path).experiment.flush()
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("loss")] == [(1, 1.0), (2, 0.5)]
    assert [event.value for event in events.Scalars("error")] == [2.0, 2.0]
    assert [row["loss"] for row in read_metrics(tmp_path)] == [1.0, 0.5]


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_others_are_torchrls_with_the_run_s_name(tmp_path, monkeypatch, name):
    calls = []
    logger = SimpleNamespace(log_scalar=lambda *scalar, step: calls.append((*scalar, step)))
    opened = []
    monkeypatch.setattr("torchrl.record.loggers.get_logger", lambda *a, **k: opened.append((a, k)) or logger)
    log_metrics(tmp_path, 1, name, loss=0.5)
    log_metrics(tmp_path, 2, name, loss=0.25)
    place = str(tmp_path), tmp_path.as_posix()
    assert [place_given for place_given, _ in opened] == [(name, *place)]
    options = opened[0][1][f"{name}_kwargs"]
    assert options.pop("project") == "dynmap_rl"
    if name == "wandb":
        assert options.pop("reinit") == "create_new"
        loggers._open.cache_clear()
        log_metrics(tmp_path, 3, name, loss=0.5)  # a process that goes on
        log_metrics(tmp_path / "other", 3, name, loss=0.5)
        ids = [call[f"{name}_kwargs"]["id"] for _, call in opened]
        assert options.pop("id") == ids[1] != ids[2]
    assert options == {}
    assert calls[:2] == [("loss", 0.5, 1), ("loss", 0.25, 2)]


def test_what_is_unknown_or_not_installed_is_one_line_before_anything_is_written(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="--logger is one of tensorboard, wandb, trackio, not 'neptune'"):
        check_logger("neptune")
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for recipe in ("decoupled", "expert"):
        result = run(tmp_path, recipe, "--logger", "wandb")
        assert (result.returncode, result.stderr) == (
            2,
            "error: --logger wandb needs it: pip install wandb\n",
        )
    assert not any(tmp_path.iterdir())
