"""Metrics as lines of JSON and in the loggers of TorchRL."""

import contextlib
import importlib
import json
import sqlite3
import sys
import time
from unittest import mock

import pytest
import torch
from commands import run

from dynmap_rl.runs import loggers
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.runs.loggers import check_logger, log_metrics


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
def test_other_loggers_get_them_with_the_runs_name(tmp_path, monkeypatch, name):
    """TorchRL's own logger, on a stand-in for the package that it imports."""
    package, module = mock.MagicMock(), importlib.import_module(f"torchrl.record.loggers.{name}")
    monkeypatch.setitem(sys.modules, name, package)
    monkeypatch.setattr(module, f"_has_{name}", True)
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
        log_metrics(tmp_path, 3, name, loss=0.5)  # a process that resumes
        log_metrics(tmp_path / "other", 3, name, loss=0.5)
        ids = [call.kwargs["id"] for call in package.init.call_args_list if "id" in call.kwargs]
        assert [ids[0] == opened.kwargs["id"], ids[1] == ids[0]] == [True, False]


def read_wandb(path):
    """Return the records of a run that ``wandb sync`` would upload."""
    from wandb.proto.wandb_internal_pb2 import Record
    from wandb.sdk.internal.datastore import DataStore

    store, records = DataStore(), []
    store.open_for_scan(str(path))
    while data := store.scan_data():
        records.append(Record.FromString(data))
    return records


@pytest.mark.slow
def test_weights_and_biases_writes_the_run_without_a_network(tmp_path, monkeypatch):
    for name, value in (("MODE", "offline"), ("ERROR_REPORTING", "false")):
        monkeypatch.setenv(f"WANDB_{name}", value)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    pytest.importorskip("wandb")
    for step in (1, 2):
        log_metrics(tmp_path / "run", step, "wandb", loss=0.123 / step)
    loggers._open("wandb", tmp_path / "run").experiment.finish()
    run_id = (tmp_path / "run/wandb/id").read_text()
    [path] = (tmp_path / "run/wandb").glob(f"offline-run-*/run-{run_id}.wandb")
    for _ in range(120):  # wandb's service writes the file's end up to a moment after ``finish``
        records = read_wandb(path)
        if any(record.HasField("exit") for record in records):
            break
        time.sleep(0.5)
    [opened] = [record.run for record in records if record.HasField("run")]
    assert (opened.project, opened.display_name) == ("dynmap_rl", (tmp_path / "run").as_posix())
    rows = [
        {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
        for record in records
        if record.HasField("history")
    ]
    assert [(row["step"], row["loss"]) for row in rows] == [(1, 0.123), (2, 0.0615)], rows


@pytest.mark.slow
def test_trackio_writes_the_run_on_this_machine(tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))  # which it reads when it is imported
    pytest.importorskip("trackio")
    for step in (1, 2):
        log_metrics(tmp_path / "run", step, "trackio", loss=1 / step)
    loggers._open("trackio", tmp_path / "run").experiment.finish()
    with contextlib.closing(sqlite3.connect(tmp_path / "trackio/dynmap_rl.db")) as database:
        rows = database.execute("SELECT run_name, step, metrics FROM metrics ORDER BY step").fetchall()
    name = (tmp_path / "run").as_posix()
    assert [(run, step, json.loads(metrics)) for run, step, metrics in rows] == [
        (name, 1, {"loss": 1.0}),
        (name, 2, {"loss": 0.5}),
    ]


def test_a_logger_that_is_unknown_or_not_installed_is_refused_before_anything_is_written(
    tmp_path, monkeypatch
):
    with pytest.raises(ValueError, match="--logger .* 'neptune'"):
        check_logger("neptune")
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for recipe in ("decoupled", "expert"):
        result = run(tmp_path, recipe, "--logger", "wandb")
        assert result.returncode == 2 and result.stderr.count("\n") == 1
        assert "uv pip install -e '.[wandb]'" in result.stderr
    assert not any(tmp_path.iterdir())
