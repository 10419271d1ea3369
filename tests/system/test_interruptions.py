"""A process that cannot write, is stopped, or finds no display: one line, and no half-written file.

A limit on the size of a file stands in for a full disk, which holds for root too.
"""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import PRESETS, run
from small import read_weights

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux' kernel")
RECIPES = Path(__file__).parents[2] / "recipes"
RUN = "runs/decoupled/balance_reaching/position_velocity_recurrent"
TRAIN = f"decoupled --config_path {PRESETS}/decoupled.yaml --run runs/new"


@pytest.fixture
def place(small_run, tmp_path):
    """Return a folder with a dataset and a finished run."""
    return shutil.copytree(small_run, tmp_path, dirs_exist_ok=True)


def start(place, command, without=(), **arguments):
    """Start a recipe as a process of its own."""
    recipe, *options = command.split()
    environment = {name: value for name, value in os.environ.items() if name not in without}
    return subprocess.Popen(
        [sys.executable, str(RECIPES / f"{recipe}.py"), *options],
        cwd=place,
        env=environment | {"TQDM_DISABLE": "1"},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        **arguments,
    )


def finish(process):
    """Return what a process writes to its standard error until it ends."""
    try:
        return process.communicate(timeout=200)[1]
    finally:
        process.kill()


@pytest.mark.slow
def test_a_full_disk(place):
    """No file of more than ``size`` bytes can be written, such as a training state."""
    size = 20_000_000

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    process = start(place, TRAIN, preexec_fn=limit)
    error = finish(process)
    assert process.returncode == 2 and error.count("\n") == 1, error
    assert re.search(r"error: .*world_model\.pt.*the command, which resumes", error)
    assert not [path.name for path in (place / "runs/new").rglob(".*") if path.name != ".lock"]

    result = run(place, *TRAIN.split())
    assert result.returncode == 0, result.stderr
    assert read_weights(place / "runs/new") == read_weights(place / RUN), "as if the disk had never been full"


@pytest.mark.slow
def test_ctrl_c(place):
    command = f"{TRAIN} --world_model.updates 3000"
    # A shell's job in the background, and with it this test, would have it ignore Ctrl-C.
    process = start(place, command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    while not (place / "runs/new/metrics.jsonl").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    error = finish(process)
    assert (process.returncode, error) == (1, "stopped; the same command resumes\n")
    assert not (place / "runs/new/eval.json").exists()


@pytest.mark.slow
def test_no_display(place):
    process = start(place, "play --size 64", without=("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"))
    error = finish(process)
    assert process.returncode == 2
    assert "error: there is no display" in error and "Traceback" not in error
