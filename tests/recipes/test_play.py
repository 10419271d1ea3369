"""The play recipe, without a display: what keys and mouse do, what is recorded."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import run
from PIL import Image, ImageSequence

from dynmap_rl.data.recording.human import keep_episode
from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.data.recording.human import publish_episodes
from dynmap_rl.data.recording.human import next_scene
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.renderer import pygame
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.checkpoints import save_policy
from dynmap_rl.modules.checkpoints import save_world_model
from dynmap_rl.play.window import PlayWindow
from dynmap_rl.play.session import Session
from dynmap_rl.play import session  # MODULE
from dynmap_rl.utils.files import write_json
from recipes.play import save_film


def press(window, *names):
    for name in names:
        for kind in (pygame.KEYDOWN, pygame.KEYUP):
            pygame.event.post(pygame.event.Event(kind, key=pygame.key.key_code(name)))
    window.handle()


@pytest.fixture
def window():
    window = PlayWindow(Session("balance_reaching"), size=128)
    yield window
    window.close()


def test_keys_and_mouse(window):
    played = window.session
    press(window, "tab")
    assert played.driver == "expert"
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_LEFT))
    window.handle()
    assert played.driver == "hand" and played.hand.direction.tolist() == [-1, 0, 0]
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.K_LEFT))
    window.handle()
    assert played.hand.direction.tolist() == [0, 0, 0]
    middle = {"pos": (8 + 64, 8 + 20 + 64), "button": 1}
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONDOWN, middle))
    window.handle()
    assert played.hand.target == (0.5, 0.5)
    pygame.event.post(pygame.event.Event(pygame.MOUSEBUTTONUP, middle))
    press(window, "space", "b")
    assert played.hand.target is None and window.paused and window.body == 0
    first = played.scene_seed
    press(window, "r", "i", "f5")
    assert played.scene_seed != first and not played.imagining, "there is no world model"
    press(window, "escape")
    assert not window.open


def test_the_window_shows_the_scene_and_traces(window):
    before = window.draw()
    window.session.driver = "expert"
    for _ in range(20):
        window.session.step()
    after = window.draw()
    assert after.shape == (window.height, window.width, 3)
    assert (before != after).any(-1).sum() > 100


@pytest.fixture
def trained(recording, tmp_path):
    folder, constants = tmp_path / "trained", load_meta(recording)["normalization"]
    world_model = make_world_model(constants, ("position",), latent_size=16, hidden_size=24)
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "seed_0/policy", make_policy(constants, "recurrent", world_model), world_model)
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
    assert steps[:6] == steps[-6:] == [1, 2, 3, 4, 5, 6], "two episodes"
    assert all(imagining == (step > 3) for step, imagining in seen)


def test_what_stands_still_keeps_its_colours_in_a_film(tmp_path):
    rng = np.random.default_rng(0)
    still = np.repeat(np.repeat(rng.integers(0, 255, (4, 4, 3), dtype=np.uint8), 16, 0), 16, 1)
    frames = []
    for i in range(40):  # beside it everything changes, to other colours
        moving = np.repeat(np.repeat(rng.integers(6 * i, 6 * i + 20, (8, 8, 3), dtype=np.uint8), 8, 0), 8, 1)
        frames.append(np.concatenate([still, moving], 1))
    save_film(frames, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as film:
        shown = [np.asarray(frame.convert("RGB"), dtype=int) for frame in ImageSequence.Iterator(film)]
    assert len(shown) == 20 and shown[0].shape == (32, 64, 3)
    # But for the last columns, which the smaller picture blends with what changes.
    assert all((frame[:, :28] == shown[0][:, :28]).all() for frame in shown)
    assert np.abs(shown[0][2:6, 2:6] - still[8, 8]).max() < 30, "and nearly its own"


def test_what_a_person_drove_becomes_a_dataset(tmp_path, monkeypatch):
    """Here the person does what the expert would."""
    monkeypatch.setattr(session.Session, "_hand_action", session.Session._expert_action)
    pushed = []
    monkeypatch.setattr("dynmap_rl.data.format.hub.push_dataset", lambda *arguments: pushed.append(arguments))
    arguments = "--driver", "hand", "--record", "mine", "--steps", 141 + 120, "--size", 64
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

    played = Session("balance_reaching", seed=7, split="train")
    for _ in range(120):
        played.step()
    assert keep_episode(tmp_path / "mine", "balance_reaching", played.episode(), played.scene_seed) == 3
    assert next_scene(tmp_path / "mine", "balance_reaching") == 8, (
        "after those that were kept, and failed, before"
    )
    publish_episodes(tmp_path / "mine", "balance_reaching")
    assert load_dataset(tmp_path / "mine", "train").shape == (2, 120)
    assert not (tmp_path / "mine.parts/old.tmp").exists()

    scenes = [row["scene_seed"] for row in load_meta(tmp_path / "mine")["episodes"]]
    assert len(set(scenes)) == 3 and scenes[:2] == [scene_seed("train", 0), scene_seed("train", 1)]

    other = run(tmp_path, "play", "--task", "bin_dropping", "--record", "mine")
    assert "mine is for human of balance_reaching, not for those of a person in bin_dropping" in other.stderr

    shutil.rmtree(tmp_path / "mine.parts/0001")
    lost = run(tmp_path, "play", "--record", "mine", "--steps", 1)
    assert "mine has 3 episodes, but mine.parts no longer holds them all" in lost.stderr
    assert load_dataset(tmp_path / "mine").shape == (3, 120)


def test_demonstrations_of_ones_own_task(tmp_path, monkeypatch):
    (tmp_path / "other_tasks.py").write_text(
        "from dynmap_rl.envs.tasks import BalanceReaching\n"
        "class Nearer(BalanceReaching):\n"
        "    name = 'nearer'\n"
        "    def is_success(self, world):\n"
        "        return world.steps >= 120\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    arguments = "--task", "other_tasks:Nearer", "--record", "mine", "--steps", 141 + 120, "--size", 64
    result = run(tmp_path, "play", *arguments)
    assert result.returncode == 0, result.stderr
    assert load_meta(tmp_path / "mine")["task"] == "other_tasks:Nearer"


def test_without_a_display_there_is_one_clear_line(tmp_path, monkeypatch):
    def fail(size):
        raise pygame.error("No available video device")

    monkeypatch.setattr(pygame.display, "set_mode", fail)
    result = run(tmp_path, "play")
    assert result.returncode == 2
    assert result.stderr.startswith("error: there is no display to open a window on (No available video")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "juggling"], "unknown task"),
        (["--steps", "0"], "--steps at least 1"),
        (["--gif", "film.gif"], "--gif needs --steps"),
        (["--imagine_from", "20"], "--imagine_from is a step of 1 to 119, and needs --policy"),
        (["--policy", "balance_reaching", "--imagine_from", "120"], "--imagine_from is a step of 1 to 119"),
        (["--push_to_hub", "someone/mine"], "--push_to_hub needs --record"),
        (["--expert", "bin_dropping"], "sees states of bin_dropping, which balance_reaching does not have"),
        (["--driver", "policy"], "--driver is one of hand, expert, not 'policy'"),
        (["--policy", "nothing"], "no checkpoint"),
        (["--expert", "nobody"], "no expert at nobody"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, "play", *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir())
