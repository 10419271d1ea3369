"""Push, pull, push again and use offline, against a stand-in hub, and errors without a hub.

The tests run in processes of their own: the hub's client reads its address from the environment when it is imported.
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

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.format.hub import _describe, draw_episodes
from dynmap_rl.data.format.reading import read_info

RECIPE = Path(__file__).parents[2] / "recipes" / "collect.py"
ONLINE = f"""
import runpy
import sys
import urllib.request
from unittest import mock

import pytest
from huggingface_hub import RepoCard, constants
from lerobot.datasets import LeRobotDataset

from dynmap_rl.data import load_dataset, load_meta
from dynmap_rl.utils.files import write_json

name = "someone/demonstrations"


def push(folder, episodes, eval_episodes):
    sizes = "--episodes", str(episodes), "--eval_episodes", str(eval_episodes)
    sys.argv = ["collect.py", "--output", folder, *sizes, "--workers", "1", "--push_to_hub", name]
    with mock.patch.object(RepoCard, "validate"):  # asks an address that cannot be changed
        runpy.run_path({str(RECIPE)!r}, run_name="__main__")


def check_pull(folder):
    assert (load_dataset(name) == load_dataset(folder)).all()
    assert load_meta(name) == load_meta(folder)


def no_dataset():
    return pytest.raises(ValueError, match=f"no dataset at {{name}}, neither .*; check the name and the network")


with no_dataset():
    load_dataset(name)
push("dataset", 4, 2)
part = LeRobotDataset(name, episodes=[2], video_backend="pyav")
assert len(part) == 120 and (part[7]["dynamics.position"] == load_dataset("dataset")[2, 7]["dynamics", "position"]).all()
assert len([*part.root.glob("data/*/*.parquet")]) == 1, "of three"

urllib.request.urlopen(constants.ENDPOINT + "/cut", b"")
with no_dataset():
    load_dataset(name)
urllib.request.urlopen(constants.ENDPOINT + "/mend", b"")
check_pull("dataset")
assert len(LeRobotDataset(name, video_backend="pyav")) == 6 * 120
write_json("dataset/meta/dynmap.json", load_meta("dataset") | {{"note": "another"}})
push("dataset", 4, 2)
check_pull("dataset")
push("smaller", 3, 1)
check_pull("smaller")
"""
OFFLINE = """
from dynmap_rl.data import load_dataset, load_meta

assert (load_dataset("someone/demonstrations") == load_dataset("smaller")).all()
assert load_meta("someone/demonstrations") == load_meta("smaller")
"""
NO_NETWORK = """
import pytest

from dynmap_rl.data import load_dataset, push_dataset

with pytest.raises(ValueError, match="no dataset at someone/else, .*; check the name and the network"):
    load_dataset("someone/else")
with pytest.raises(OSError, match="cannot push .* to someone/else .*; check the name, the network"):
    push_dataset("dataset", "someone/else")
"""


@pytest.fixture
def hub():
    script = Path(__file__).with_name("stand_in_hub.py")
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    yield process.stdout.readline().strip()
    process.terminate()
    process.wait()


@pytest.fixture
def run(installed, tmp_path):
    """Run code on the installed package, with a hub at an address."""

    def run(code, endpoint, offline="0"):
        environment = {
            "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(installed),
            "HF_ENDPOINT": endpoint,
            "HF_TOKEN": "hf_dummy",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_OFFLINE": offline,
            "HF_HOME": str(tmp_path / "home"),
            "HF_LEROBOT_HOME": str(tmp_path / "home/lerobot"),
        }
        command, environment = [sys.executable, "-c", code], os.environ | environment
        result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert result.returncode == 0, result.stderr
        return result.stdout

    return run


@pytest.mark.slow
def test_push_a_pull_that_is_cut_off_pull_push_again_and_use_offline(recording, tmp_path, hub, run):
    shutil.copytree(recording, tmp_path / "dataset")
    assert run(ONLINE, hub).splitlines()[-1] == "pushed: someone/demonstrations"
    run(OFFLINE, hub, offline="1")
    run(OFFLINE, "http://127.0.0.1:9")  # no network, and nobody said so

    address = f"{hub}/datasets/someone/demonstrations/resolve/v3.0"
    card = urllib.request.urlopen(f"{address}/README.md").read().decode()
    assert "license: mit" in card
    assert "| `dynamics.velocity` | 6 |" in card
    assert "train 0 to 2, eval 3 to 3" in card
    assert "--episodes 3 --eval_episodes 1" in card
    assert "More Information Needed" not in card
    picture = Image.open(urllib.request.urlopen(f"{address}/picture.png"))
    assert "](picture.png)" in card and picture.size == (8 * 128, 3 * 128)


RUN = """
import subprocess
from pathlib import Path

import pytest
import torch

from dynmap_rl.runs.lookup import SHIPPED, find_run, load_actor

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
with pytest.raises(ValueError, match="no run at someone/else, neither as a folder nor on the hub"):
    find_run("someone/else")
"""


@pytest.mark.slow
def test_a_run_folder_goes_there_and_back_and_is_found_offline(hub, run):
    run(RUN.format(push=True), hub)
    run(RUN.format(push=False), hub, offline="1")


@pytest.mark.slow
def test_without_a_network_there_is_one_clear_error(recording, tmp_path, run):
    shutil.copytree(recording, tmp_path / "dataset")
    run(NO_NETWORK, "http://127.0.0.1:9")  # nobody listens


def test_the_card_says_where_the_dynamics_are_from(recording):
    derived, features = {"source": "flow", "verdict": "doubtful"}, read_info(recording)["features"]
    point = features | {"dynamics.position": {"shape": [2], "names": ["x", "y"]}}
    cards = [
        _describe(load_meta(recording), *parts)
        for parts in ((features, "Carry the block.", None), (point, "Carry the block.", derived))
    ]
    assert ["| `dynamics.position` | 2 | x, y (m" in card for card in cards] == [False, True]
    assert not any("dynamics.found" in card for card in cards)
    assert ["--source flow`" in card for card in cards] == [False, True]
    assert ["simulator's" in card for card in cards] == [True, False]


def test_the_picture_shows_frames(recording, tmp_path):
    episodes = load_dataset(recording, "train")
    draw_episodes(episodes, tmp_path / "picture.png", rows=2, columns=3, zoom=1)
    picture = np.asarray(Image.open(tmp_path / "picture.png"))
    assert (picture[64:, 128:] == episodes["pixels"][1, -1].permute(1, 2, 0).numpy()).all()
