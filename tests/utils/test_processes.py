"""Stages in processes: their order, their errors, and processes that die."""

import importlib
import os
import sys

import pytest
import torch

from dynmap_rl.utils.processes import map_processes, run_processes, run_script

STAGES = """
import os
import time

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

def square(number):
    if number == 100:
        time.sleep(1)  # until the others have taken their share
    if number < 0:
        raise ValueError("this one is negative")
    return number**2, os.getpid()

def third_of(own):
    time.sleep(1)  # this process works on its own share
    if os.getpid() != own:
        os._exit(1)
"""


@pytest.fixture
def stages(tmp_path, monkeypatch):
    """Return a module that other processes can import."""
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages" / "some_stages.py").write_text(STAGES)
    monkeypatch.syspath_prepend(tmp_path / "stages")
    yield importlib.import_module("some_stages")
    del sys.modules["some_stages"]


@pytest.mark.parametrize("count", [1, 2])
def test_every_stage_follows_the_one_before(tmp_path, stages, count):
    (tmp_path / "out").mkdir()
    numbers = 0, 2, 3
    run_processes([stages.first, stages.second], [(tmp_path / "out", n) for n in numbers], count)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {f"{stage}_{n}" for stage in ("first", "second") for n in numbers}


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_in_a_process_is_raised(tmp_path, stages, count):
    with pytest.raises(ValueError, match="this one fails"):
        run_processes([stages.first, stages.second], [(tmp_path, n) for n in range(4)], count)


def test_a_process_that_dies_is_an_error(tmp_path, stages):
    with pytest.raises(OSError, match="a process died"):
        run_processes([stages.first, stages.third], [(tmp_path, 0), (tmp_path, 1)], 2)


@pytest.mark.parametrize("count", [1, 3])
def test_values_come_in_the_order_of_their_arguments(stages, count):
    values = map_processes(stages.square, [*range(20), 100], count)
    assert [value for value, _ in values] == [n**2 for n in (*range(20), 100)]
    assert (len({process for _, process in values}) > 1) == (count > 1)


@pytest.mark.parametrize("numbers", [[-1, 1, 2, 100], [1, 2, 3, -1]])
def test_an_error_in_a_call_is_raised(stages, numbers):
    with pytest.raises(ValueError, match="negative"):
        map_processes(stages.square, numbers, 2)


def test_a_process_that_dies_in_a_call_is_an_error(stages):
    with pytest.raises(OSError, match="a process died"):
        map_processes(stages.third_of, [os.getpid()] * 3, 2)


def test_a_script_runs_with_its_arguments_in_its_folder(tmp_path):
    (tmp_path / "script.py").write_text("import os, sys; print(os.getcwd(), sys.argv[1:]); sys.exit(3)")
    (tmp_path / "here").mkdir()
    assert run_script(tmp_path / "script.py", ["--a", "1"], tmp_path / "here", tmp_path / "log") == 3
    assert (tmp_path / "log").read_text() == f"{tmp_path / 'here'} ['--a', '1']\n"


def test_a_script_has_the_number_of_threads(tmp_path):
    (tmp_path / "script.py").write_text("import torch; print(torch.get_num_threads())")
    for threads in 1, 2:
        assert run_script(tmp_path / "script.py", [], tmp_path, tmp_path / "log", threads) == 0
    assert (tmp_path / "log").read_text().split() == ["1", "2"]


def test_work_in_this_process_leaves_the_number_of_threads():
    before = torch.get_num_threads()
    run_processes([torch.set_num_threads], [before + 1], 1)
    assert torch.get_num_threads() == before
