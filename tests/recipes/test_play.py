"""The play recipe without a display: animations, imagination, recorded demonstrations, bad input."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run
from PIL import Image, ImageSequence
from small import CONSTANTS, make_model

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.recording.human import keep_episode, next_scene
from dynmap_rl.envs.renderer import pygame
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.modules.checkpoints import make_policy, save_policy, save_world_model
from dynmap_rl.play.session import Session
from dynmap_rl.play.window import PlayWindow
from dynmap_rl.utils.files import write_json
from recipes.play import save_film

TASK = "other_tasks:Nearer"


@pytest.fixture
def trained(tmp_path):
    folder, world_model = tmp_path / "trained", make_model()
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "seed_0/policy", make_policy(CONSTANTS, "recurrent", world_model), world_model)
    write_json(folder / "config.json", {"task": "bin_dropping"})
    return folder


def test_a_policy_is_watched_and_filmed(trained, tmp_path):
    result = run(tmp_path, "play", "--policy", trained, "--steps", 6, "--size", 128, "--gif", "film.gif")
    assert result.returncode == 0, result.stderr
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 3


def test_imagination_begins_at_its_step_of_every_episode(trained, tmp_path, monkeypatch):
    seen, draw = [], PlayWindow.draw

    def watch(window):
        seen.append((window.session.world.steps, window.session.imagining))
        return draw(window)

    monkeypatch.setattr(PlayWindow, "draw", watch)
    arguments = "--policy", trained, "--imagine_from", 3, "--steps", 140 + 6, "--size", 64
    result = run(tmp_path, "play", *arguments)
    assert result.returncode == 0, result.stderr
    steps = [step for step, _ in seen]
    assert steps[:6] == steps[-6:] == [1, 2, 3, 4, 5, 6]  # of two episodes
    assert all(imagining == (step > 3) for step, imagining in seen)


def test_still_parts_keep_their_colours_in_an_animation(tmp_path):
    rng = np.random.default_rng(0)
    still = np.repeat(np.repeat(rng.integers(0, 255, (4, 4, 3), dtype=np.uint8), 16, 0), 16, 1)
    frames = []
    for i in range(40):  # the right half changes to other colours
        moving = np.repeat(np.repeat(rng.integers(6 * i, 6 * i + 20, (8, 8, 3), dtype=np.uint8), 8, 0), 8, 1)
        frames.append(np.concatenate([still, moving], 1))
    save_film(frames, tmp_path / "film.gif", dt=0.04)
    with Image.open(tmp_path / "film.gif") as film:
        shown = [np.asarray(frame.convert("RGB"), dtype=int) for frame in ImageSequence.Iterator(film)]
        assert film.info["duration"] == 80, "a picture for two steps"
    assert len(shown) == 20 and shown[0].shape == (32, 64, 3)
    # The smaller picture blends the last columns with the right half.
    assert all((frame[:, :28] == shown[0][:, :28]).all() for frame in shown)
    assert np.abs(shown[0][2:6, 2:6] - still[8, 8]).max() < 30


def test_an_animation_lasts_as_long_as_its_episode(tmp_path):
    frames = list(np.random.default_rng(0).integers(0, 255, (80, 32, 32, 3), dtype=np.uint8))
    save_film(frames, tmp_path / "film.gif", dt=1 / 80)
    with Image.open(tmp_path / "film.gif") as film:
        durations = [frame.info["duration"] for frame in ImageSequence.Iterator(film)]
    assert sum(durations) == 1000


def test_episodes_of_a_person_become_a_dataset(tmp_path, monkeypatch):
    """The expert acts in the place of the person."""
    monkeypatch.setattr(Session, "_person_action", Session._expert_action)
    pushed = []
    monkeypatch.setattr("dynmap_rl.data.format.hub.check_login", lambda: None)
    monkeypatch.setattr("dynmap_rl.data.format.hub.push_dataset", lambda *arguments: pushed.append(arguments))
    arguments = "--driver", "person", "--record", "mine", "--steps", 141 + 120, "--size", 64
    result = run(tmp_path, "play", *arguments, "--push_to_hub", "someone/mine")
    assert result.returncode == 0, result.stderr
    assert pushed == [(Path("mine"), "someone/mine")] and "pushed: someone/mine" in result.stdout
    assert "kept: 2 episodes in mine.parts" in result.stdout and "2 episodes: mine" in result.stdout
    assert load_dataset(tmp_path / "mine").shape == (2, 120)
    page = (tmp_path / "runs/play/mine/report.html").read_text()
    assert "2 episodes (train 0:1, eval 1:2)" in page and page.count("data:image/") == 2
    meta = load_meta(tmp_path / "mine")
    assert (meta["kind"], meta["splits"]) == ("human", {"train": [0, 1], "eval": [1, 2]})
    assert all(row["success"] for row in meta["episodes"])


@pytest.mark.slow
def test_later_episodes_are_added_to_a_dataset_of_ones_own_task(recording, tmp_path, monkeypatch):
    (tmp_path / "other_tasks.py").write_text(
        "from dynmap_rl.envs.tasks import BalanceReaching\n"
        "class Nearer(BalanceReaching):\n"
        "    name = 'nearer'\n"
        "    def is_success(self, world):\n"
        "        return world.steps >= 120\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    arguments = "--driver", "person", "--task", TASK, "--record", "mine", "--steps", 141 + 120, "--size", 64
    result = run(tmp_path, "play", *arguments)
    assert result.returncode == 0, result.stderr
    assert load_meta(tmp_path / "mine")["task"] == TASK

    played = Session(TASK, seed=7, split="train")
    for _ in range(120):
        played.step()
    assert keep_episode(tmp_path / "mine", TASK, played.episode(), played.scene_seed) == 3
    assert next_scene(tmp_path / "mine", TASK) == 8
    arguments = "--driver", "person", "--task", TASK, "--record", "mine", "--steps", 1, "--size", 64
    result = run(tmp_path, "play", *arguments)  # keeps none, and publishes that of a session that was killed
    assert result.returncode == 0, result.stderr
    assert load_dataset(tmp_path / "mine", "train").shape == (2, 120)
    assert not (tmp_path / "mine.parts/old.tmp").exists()
    scenes = [row["scene_seed"] for row in load_meta(tmp_path / "mine")["episodes"]]
    assert scenes == [scene_seed("train", number) for number in (0, 1, 7)]

    other = run(tmp_path, "play", "--task", "bin_dropping", "--record", "mine")
    assert other.returncode == 2 and TASK in other.stderr and "bin_dropping" in other.stderr
    shutil.copytree(recording, tmp_path / "recorded")
    other = run(tmp_path, "play", "--record", "recorded")
    assert other.returncode == 2 and "kind human" in other.stderr and "demonstrations" in other.stderr
    shutil.rmtree(tmp_path / "mine.parts/0001")
    lost = run(tmp_path, "play", "--task", TASK, "--record", "mine", "--steps", 1)
    assert lost.returncode == 2 and "mine.parts" in lost.stderr
    assert load_dataset(tmp_path / "mine").shape == (3, 120)


def test_without_a_display_the_error_is_one_line(tmp_path, monkeypatch):
    def fail(size):
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "set_mode", fail)
    result = run(tmp_path, "play")
    assert result.returncode == 2
    assert "No available video device" in result.stderr and result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "juggling"], "juggling"),
        (["--steps", "0"], "--steps"),
        (["--gif", "film.gif"], "--steps"),
        (["--imagine_from", "20"], "--policy"),
        (["--delay", "3"], "--policy"),
        (["--policy", "balance_reaching", "--delay", "21"], "--delay must be 0 to 20"),
        (["--policy", "balance_reaching", "--imagine_from", "120"], "got 120"),
        (["--push_to_hub", "someone/mine"], "--record"),
        (["--expert", "bin_dropping"], "--expert"),
        (["--driver", "policy"], "give --policy"),
        (["--policy", "nothing"], "nothing"),
        (["--expert", "nobody"], "nobody"),
    ],
)
def test_bad_input_gets_an_error_of_one_line(tmp_path, arguments, message):
    result = run(tmp_path, "play", *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())
