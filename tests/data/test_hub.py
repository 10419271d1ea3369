"""Push, pull, push again and use offline, against a stand-in hub; and what is said when there is none.

In processes of their own: the hub's client takes its address from the environment when it is imported.
"""

import os
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dynmap_rl.data import load_dataset
from dynmap_rl.data.hub import draw_episodes

ONLINE = """
import urllib.request
from unittest import mock

import pytest
from huggingface_hub import RepoCard, constants

from dynmap_rl.data import load_dataset, load_meta, push_dataset
from dynmap_rl.runs import write_json

name = "someone/demonstrations"
with pytest.raises(ValueError, match=f"no dataset at {{name}}, neither as a folder nor .*; check the name"):
    load_dataset(name)
for note in ("first", "second"):
    meta = load_meta({root!r}) | {{"note": note}}
    write_json({root!r} + "/meta/dynmap.json", meta)
    with mock.patch.object(RepoCard, "validate"):  # asks an address that cannot be changed
        push_dataset({root!r}, name)
    if note == "first":
        urllib.request.urlopen(constants.ENDPOINT + "/cut", b"")
        with pytest.raises(ValueError, match="no dataset at .*; check the name and the network"):
            load_dataset(name)
        urllib.request.urlopen(constants.ENDPOINT + "/mend", b"")
    assert (load_dataset(name) == load_dataset({root!r})).all()
    assert load_meta(name) == meta

from lerobot.datasets import LeRobotDataset

assert len(LeRobotDataset(name, video_backend="pyav")) == 6 * 120
part = LeRobotDataset(name, episodes=[1], video_backend="pyav")
assert len(part) == 120 and (part[7]["dynamics.position"] == load_dataset({root!r})[1, 7]["dynamics", "position"]).all()
"""
OFFLINE = """
from dynmap_rl.data import load_dataset, load_meta

assert (load_dataset("someone/demonstrations") == load_dataset({root!r})).all()
assert load_meta("someone/demonstrations")["note"] == "second"
"""
NO_NETWORK = """
import pytest

from dynmap_rl.data import load_dataset, push_dataset

with pytest.raises(ValueError, match="no dataset at someone/else, .*; check the name and the network"):
    load_dataset("someone/else")
with pytest.raises(OSError, match="cannot push .* to someone/else .*; check the name, the network"):
    push_dataset({root!r}, "someone/else")
"""


@pytest.fixture
def hub():
    script = Path(__file__).with_name("stand_in_hub.py")
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    yield process.stdout.readline().strip()
    process.terminate()
    process.wait()


def run(code, endpoint, home, offline="0"):
    environment = {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "HF_ENDPOINT": endpoint,
        "HF_TOKEN": "hf_dummy",
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_OFFLINE": offline,
        "HF_HOME": str(home),
        "HF_LEROBOT_HOME": str(home / "lerobot"),
    }
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
def test_push_a_pull_that_is_cut_off_pull_push_again_and_use_offline(recording, tmp_path, hub):
    root = str(shutil.copytree(recording, tmp_path / "dataset"))
    run(ONLINE.format(root=root), hub, tmp_path / "home")
    run(OFFLINE.format(root=root), hub, tmp_path / "home", offline="1")
    run(OFFLINE.format(root=root), "http://127.0.0.1:9", tmp_path / "home")  # no network, and nobody said so

    address = f"{hub}/datasets/someone/demonstrations/resolve/v3.0"
    card = urllib.request.urlopen(f"{address}/README.md").read().decode()
    assert "license: mit" in card
    assert "| `dynamics.velocity` | 6 |" in card
    assert "train 0 to 3, eval 4 to 5" in card
    assert "--episodes 4 --eval_episodes 2" in card
    assert "More Information Needed" not in card
    picture = Image.open(urllib.request.urlopen(f"{address}/picture.png"))
    assert "](picture.png)" in card and picture.size == (8 * 128, 3 * 128)


RUN = """
import subprocess
from pathlib import Path

import pytest
import torch

from dynmap_rl.modules import load_actor
from dynmap_rl.modules.checkpoints import SHIPPED, find_run

run = SHIPPED / "balance_reaching"
parts = ["config.json", "eval.json", "world_model/*", "seed_*/policy/*", "seed_*/world_model/*"]
command = ["hf", "upload", "someone/run", str(run), "."] + [word for part in parts for word in ("--include", part)]
if {push}:
    subprocess.run(command, check=True)
found = find_run("someone/run")
assert found != Path("someone/run")
files = [sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()) for folder in (run, found)]
assert files[0] == files[1]
for ours, theirs in zip(*(load_actor(name).state_dict().values() for name in (run, "someone/run"))):
    assert torch.equal(ours, theirs)
with pytest.raises(ValueError, match="no policy at someone/else, neither as a folder nor on the hub"):
    find_run("someone/else")
"""


@pytest.mark.slow
def test_a_run_folder_goes_there_and_back_and_is_found_offline(tmp_path, hub):
    run(RUN.format(push=True), hub, tmp_path / "home")
    run(RUN.format(push=False), hub, tmp_path / "home", offline="1")


@pytest.mark.slow
def test_without_a_network_there_is_one_clear_error(recording, tmp_path):
    root = str(shutil.copytree(recording, tmp_path / "dataset"))
    run(NO_NETWORK.format(root=root), "http://127.0.0.1:9", tmp_path / "home")  # nobody listens


def test_the_picture_shows_frames(recording, tmp_path):
    episodes = load_dataset(recording, "train")
    draw_episodes(episodes, tmp_path / "picture.png", rows=2, columns=3, zoom=1)
    picture = np.asarray(Image.open(tmp_path / "picture.png"))
    assert (picture[64:, 128:] == episodes["pixels"][1, -1].permute(1, 2, 0).numpy()).all()
