"""Push, pull, push again and use offline, against a stand-in hub.

In processes of their own: the hub's client takes its address from the environment when it is imported.
"""

import os
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

ONLINE = """
from unittest import mock

from huggingface_hub import RepoCard

from dynmap_rl.data import load_dataset, load_meta, push_dataset
from dynmap_rl.runs import write_json

name = "someone/demonstrations"
try:
    load_dataset(name)
except ValueError as error:
    assert f"no dataset at {{name}}, neither as a folder nor" in str(error), error
else:
    raise AssertionError("loaded what nobody pushed")
for note in ("first", "second"):
    meta = load_meta({root!r}) | {{"note": note}}
    write_json({root!r} + "/meta/dynmap.json", meta)
    with mock.patch.object(RepoCard, "validate"):  # asks an address that cannot be changed
        push_dataset({root!r}, name)
    assert (load_dataset(name) == load_dataset({root!r})).all()
    assert load_meta(name) == meta

from lerobot.datasets import LeRobotDataset

assert len(LeRobotDataset(name, video_backend="pyav")) == 6 * 120
"""
OFFLINE = """
from dynmap_rl.data import load_dataset, load_meta

assert (load_dataset("someone/demonstrations") == load_dataset({root!r})).all()
assert load_meta("someone/demonstrations")["note"] == "second"
"""


@pytest.fixture
def hub():
    script = Path(__file__).with_name("stand_in_hub.py")
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    yield process.stdout.readline().strip()
    process.terminate()
    process.wait()


@pytest.mark.slow
def test_push_pull_push_again_and_use_offline(recording, tmp_path, hub):
    root = str(shutil.copytree(recording, tmp_path / "dataset"))
    home = tmp_path / "home"
    environment = {
        "HF_ENDPOINT": hub,
        "HF_TOKEN": "hf_dummy",
        "HF_HUB_DISABLE_XET": "1",
        "HF_HOME": str(home),
    }
    for code, offline in ((ONLINE, "0"), (OFFLINE, "1")):
        result = subprocess.run(
            [sys.executable, "-c", code.format(root=root)],
            env={
                **os.environ,
                **environment,
                "HF_HUB_OFFLINE": offline,
                "HF_LEROBOT_HOME": str(home / "lerobot"),
            },
            capture_output=True,
            text=True,
        )
        assert result.returncode == 0, result.stderr

    card = (
        urllib.request.urlopen(f"{hub}/datasets/someone/demonstrations/resolve/v3.0/README.md")
        .read()
        .decode()
    )
    assert "license: mit" in card
    assert "| `dynamics.velocity` | 6 |" in card
    assert "train 0 to 3, eval 4 to 5" in card
