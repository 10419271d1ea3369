"""Tests without network or display, on one thread, and one small recording for each task, which all tests share."""

import contextlib
import functools
import json
import os
import subprocess
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["OMP_NUM_THREADS"] = "1"  # for processes that tests start
os.environ["TQDM_DISABLE"] = "1"

import pytest
import torch

from dynmap_rl.utils.graphics import check_mujoco_gl

try:
    check_mujoco_gl()
except OSError as error:  # otherwise every file of tests that imports TorchRL fails
    raise pytest.UsageError(str(error)) from error

torch.set_num_threads(1)
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """Return a folder with the package and LeRobot's plugins as their wheels install them, for ``PYTHONPATH``."""
    build_wheel = pytest.importorskip("hatchling.build").build_wheel
    wheels, site = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    plugins = sorted((ROOT / "dynmap_rl/integrations").glob("lerobot_*_dynmap"))
    assert len(plugins) == 2
    for project in (ROOT, *plugins):
        with contextlib.chdir(project):
            name = build_wheel(str(wheels))
        with zipfile.ZipFile(wheels / name) as wheel:
            wheel.extractall(site)
    return site


@pytest.fixture(scope="session")
def command(installed):
    """Return a function that runs a script in a folder on the installed package; it returns exit code and output."""
    process = subprocess.Popen(
        [sys.executable, "-P", str(ROOT / "tests/worker.py")],
        env=os.environ | {"PYTHONPATH": str(installed)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert Path(json.loads(process.stdout.readline())).is_relative_to(installed)

    def run(folder, script, *arguments):
        line = [str(word) for word in (folder, script, *arguments)]
        print(json.dumps(line), file=process.stdin, flush=True)
        return subprocess.CompletedProcess(line, *json.loads(process.stdout.readline()))

    yield run
    process.communicate()


@pytest.fixture(scope="session")
def shared(tmp_path_factory):
    """Return a folder that all workers of pytest-xdist share."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    (root / "shared").mkdir(exist_ok=True)
    return root / "shared"


@pytest.fixture
def ray(shared, monkeypatch):
    """Let the test start a Ray cluster of its own: of two clusters that start at the same time, both may fail."""
    from filelock import FileLock

    if find_spec("ray") is None:
        pytest.skip("Ray is not installed")
    monkeypatch.setenv("RAY_ADDRESS", "local")  # otherwise Ray would join the last cluster of this machine
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with FileLock(shared / "ray.lock"):
        yield
        import ray

        ray.shutdown()


@pytest.fixture(scope="session")
def recordings(shared):
    """Return a function from a task to a small dataset, 4 + 2 demonstrations in three shards, which is read only."""
    from filelock import FileLock

    from dynmap_rl.data.recording import record as module

    @functools.cache
    def record(task: str) -> Path:
        with pytest.MonkeyPatch.context() as patch, FileLock(shared / f"{task}.lock"):
            patch.setattr(module, "SHARD_EPISODES", 2)
            return module.record_dataset(shared / task / "recording", task, "demonstrations", 4, 2, workers=1)

    return record


@pytest.fixture(scope="session")
def recording(recordings):
    """Return the dataset of task 1."""
    return recordings("balance_reaching")


@pytest.fixture(scope="session")
def small_run(shared, recordings):
    """Return a folder, which is read only, with ``datasets/balance_reaching`` and a finished run of ``decoupled``.

    The run lies at its default place, and ``printed.txt`` holds its output.
    """
    import commands
    from filelock import FileLock

    folder = shared / "small_run"
    with FileLock(shared / "small_run.lock"):
        if not (folder / "printed.txt").exists():
            folder.mkdir()
            commands.place_recordings(folder, recordings, "balance_reaching")
            result = commands.run_small(folder, "decoupled", pictures=True)
            (folder / "printed.txt").write_text(result.stdout)
    return folder
