"""No network, no display, one thread; and one small recording a task that the tests share."""

import contextlib
import functools
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"
os.environ["SDL_VIDEODRIVER"] = "dummy"
os.environ["OMP_NUM_THREADS"] = "1"  # of recipes that a test starts

import pytest
import torch

torch.set_num_threads(1)
ROOT = Path(__file__).parents[1]


def pytest_configure(config):
    config.addinivalue_line("markers", "slow: starts processes of its own; leave out with -m 'not slow'")


@pytest.fixture(scope="session")
def installed(tmp_path_factory):
    """The folder of the package and of LeRobot's plugin as their wheels hold them: to be named in ``PYTHONPATH``."""
    build_wheel = pytest.importorskip("hatchling.build").build_wheel
    wheels, site = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("site")
    for project in (ROOT, ROOT / "dynmap_rl/integrations/lerobot_policy_dynmap"):
        with contextlib.chdir(project):
            name = build_wheel(str(wheels))
        with zipfile.ZipFile(wheels / name) as wheel:
            wheel.extractall(site)
    return site


@pytest.fixture(scope="session")
def command(installed):
    """Run a script with arguments in a folder, on the package as it is installed: its exit code and what it printed."""
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
def recordings(tmp_path_factory):
    """The folder of a small dataset of a task, 4 + 2 demonstrations in three shards; not to be written to."""
    from dynmap_rl.data.recording.shards import record_dataset
    from dynmap_rl.data import recording  # MODULE

    root = tmp_path_factory.mktemp("datasets")

    @functools.cache
    def record(task: str) -> Path:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(recording, "SHARD_EPISODES", 2)
            return record_dataset(root / task / "recording", task, episodes=4, eval_episodes=2, workers=1)

    return record


@pytest.fixture(scope="session")
def recording(recordings):
    """That of task 1."""
    return recordings("balance_reaching")
