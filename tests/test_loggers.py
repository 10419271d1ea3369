"""Metrics as lines of JSON, and where else a user wants them."""

import importlib
import sys
from unittest import mock

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
def test_others_get_them_by_torchrls_loggers_with_the_runs_name(tmp_path, monkeypatch, name):
    """TorchRL's own logger, on a stand-in for the package that it imports."""
    package = mock.MagicMock()
    monkeypatch.setitem(sys.modules, name, package)
    monkeypatch.setattr(importlib.import_module(f"torchrl.record.loggers.{name}"), f"_has_{name}", True)
    log_metrics(tmp_path, 1, name, loss=0.5)
    log_metrics(tmp_path, 2, name, loss=0.25)
    [opened] = package.init.call_args_list
    assert (opened.kwargs["project"], opened.kwargs["name"]) == ("dynmap_rl", tmp_path.as_posix())
    logged = [(call.args[0]["loss"], call.kwargs.get("step")) for call in package.init().log.call_args_list]
    assert [value for value, _ in logged] == [0.5, 0.25]
    if name == "trackio":
        assert [step for _, step in logged] == [1, 2]
    else:
        assert opened.kwargs["reinit"] == "create_new"
        package.init.reset_mock()
        loggers._open.cache_clear()
        log_metrics(tmp_path, 3, name, loss=0.5)  # a process that goes on
        log_metrics(tmp_path / "other", 3, name, loss=0.5)
        ids = [call.kwargs["id"] for call in package.init.call_args_list if "id" in call.kwargs]
        assert [ids[0] == opened.kwargs["id"], ids[1] == ids[0]] == [True, False]


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
