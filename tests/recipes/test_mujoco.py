"""The pipeline on a MuJoCo task of one's own: recorded, loaded, shown, trained on and judged."""

import json

import numpy as np
import pytest
import torch
from commands import run, run_small
from own_task import check_renderer, own_task  # noqa: F401
from PIL import Image

from dynmap_rl.data.demonstrations import load_dataset, load_demonstrations, load_meta
from dynmap_rl.envs.protocol import Layout
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.play.session import Session
from dynmap_rl.runs.lookup import load_actor


@pytest.fixture(scope="module")
def recorded(own_task, tmp_path_factory):  # noqa: F811
    """Return a folder with a recording of two cameras, and the name of its task."""
    folder, task = tmp_path_factory.mktemp("recorded"), f"{own_task}:image_size=96,cameras=2"
    arguments = "--episodes", "3", "--eval_episodes", "2", "--workers", "1"
    result = run(folder, "collect", "--task", task, *arguments)
    assert result.returncode == 0, result.stderr
    return folder, task


def test_a_recording_holds_what_the_layout_names(recorded):
    folder, task = recorded
    layout, root = get_task(task).layout, folder / "datasets/push_image_size_96_cameras_2"
    info = json.loads((root / "meta/info.json").read_text())
    assert (info["fps"], info["robot_type"]) == (20, "mujoco")
    for quantity, names in layout.dynamics.items():
        assert info["features"][f"dynamics.{quantity}"]["names"] == list(names)
    cameras = [name for name, feature in info["features"].items() if feature["dtype"] == "image"]
    assert cameras == ["observation.images.front", "observation.images.top"]
    assert Layout.from_dict(load_meta(root)["layout"]) == layout
    page = (folder / "runs/collect/push_image_size_96_cameras_2/report.html").read_text()
    assert "puck_zaxis_y" in page and page.count("data:image/") == 2


def test_a_loaded_episode_is_what_the_task_shows(recorded):
    folder, name = recorded
    root, task = folder / "datasets/push_image_size_96_cameras_2", get_task(name)
    episodes, meta = load_dataset(root), load_meta(root)
    assert episodes["pixels"].shape == (5, 40, 3, 96, 192) and episodes["goal"].shape == (5, 40, 3)
    assert episodes["next", "is_success"][:, -1].all()
    draw = task.make_renderer()
    for row, episode in zip(meta["episodes"], episodes, strict=True):
        world = task.begin(row["scene_seed"])
        for t in range(0, 10):
            assert (episode["pixels"][t].permute(1, 2, 0).numpy() == draw(world)).all()
            np.testing.assert_array_equal(episode["dynamics", "velocity"][t], world.velocity.astype("f4"))
            task.step([world], [episode["action"][t].numpy()])
    noisy = [row["noise"] > 0 for row in meta["episodes"]]
    same = (episodes["action"] == episodes["expert_action"]).all((1, 2)).tolist()
    assert any(noisy) and same == [not noise for noise in noisy]


def test_ranges_of_axes_are_natural_and_points_share_a_width(recorded):
    folder, _ = recorded
    _, constants = load_demonstrations(folder / "datasets/push_image_size_96_cameras_2")
    low, high = (np.array(constants["position"][end]) for end in ("low", "high"))
    assert (low[3:6] == -1).all() and (high[3:6] == 1).all()
    assert np.allclose((high - low)[:3], (high - low)[0]) and (high - low)[0] > 0.1
    assert constants["action"] == {"low": [-1.0], "high": [1.0]}


def test_policies_are_trained_and_judged(recorded):
    folder, name = recorded
    arguments = "--task", name, "--world_model.supervision", "position,velocity"
    assert "SR" in run_small(folder, "decoupled", *arguments, pictures=True).stdout
    path = folder / "runs/decoupled/push_image_size_96_cameras_2/position_velocity_recurrent"
    result = json.loads((path / "eval.json").read_text())
    assert result["test_protocol"]["episodes"] == 3 and result["task"] == name
    assert result["test_protocol"]["localization"] > 0
    assert {p.name for p in (path / "figures").iterdir()} == {"dynamics.png", "reconstruction.png"}
    actor = load_actor(path)
    assert (actor.world_model.image_size, actor.world_model.cameras) == (96, 2)
    assert actor.world_model.encode(torch.zeros(1, 3, 96, 192, dtype=torch.uint8)).shape == (1, 64)
    judged = run(folder, "evaluate", "--policy", path, "--eval.episodes", "2")
    assert judged.returncode == 0 and "SR" in judged.stdout
    probed = run(folder, "probe", "--runs", path, "--task", name, "--train_episodes", "3")
    assert probed.returncode == 0, probed.stderr
    facts = json.loads((folder / "runs/probe/probe.json").read_text())
    entries = len(get_task(name).layout.dynamics["velocity"])
    assert len(facts["probes"]["RGB+[P+V], decoupled"]["hidden1"]["velocity"]) == entries
    assert facts["verdicts"]["RGB+[P+V], decoupled"]["verdict"] in ("good", "doubtful")


def test_the_expert_is_judged(recorded):
    folder, name = recorded
    judged = run(folder, "evaluate", "--task", name, "--eval.episodes", "3")
    assert judged.returncode == 0, judged.stderr
    [file] = (folder / "runs/evaluate").glob("*scripted*/eval.json")
    result = json.loads(file.read_text())
    assert result["rates"]["success"] == 100 and result["expert"] == "scripted"


def test_a_person_and_the_expert_drive(own_task):  # noqa: F811
    session = Session(own_task)
    assert session.drivers == ("person", "expert")
    session.person.direction[:] = 1, 0, 0  # to the right, as the camera looks along y
    session.step()
    assert session.td["dynamics", "velocity"][0, 6] > 0 and session.steps[0]["action"].tolist() == [[1.0]]
    session.restart()
    session.driver = "expert"
    while not session.over:
        session.step()
    assert session.succeeded and session.episode().shape == (1, 40)
    assert np.isnan(session.trace["position", "predicted"]).all()


def test_a_policy_is_watched_and_a_person_recorded(recorded, tmp_path, monkeypatch):
    """The expert acts in the place of the person."""
    _, task = recorded
    monkeypatch.setattr(Session, "_person_action", Session._expert_action)
    arguments = "--task", task, "--driver", "person", "--record", "mine", "--steps", "101", "--size", "64"
    played = run(tmp_path, "play", *arguments, "--gif", "film.gif")
    assert played.returncode == 0, played.stderr
    assert load_dataset(tmp_path / "mine").shape == (2, 40)
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames > 1


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["joint", "end_to_end"])
def test_other_trainings_take_the_task(recorded, recipe):
    folder, name = recorded
    assert "SR" in run_small(folder, recipe, "--task", name).stdout


@pytest.mark.parametrize(
    ("recipe", "arguments", "message"),
    [
        ("collect", ["--expert", "balance_reaching"], "has an expert of its own"),
        ("expert", [], "must be a task of cart and block"),
        ("play", ["--expert", "balance_reaching"], "has an expert of its own"),
        ("decoupled", ["--world_model.augmentation.max_shift", "3"], "augmentation has no effect"),
        ("decoupled", ["--dataset", "datasets/push_image_size_96_cameras_2"], "dataset of"),
    ],
)
def test_what_has_no_effect_is_refused(recorded, own_task, recipe, arguments, message):  # noqa: F811
    result = run(recorded[0], recipe, "--task", own_task, *arguments)
    assert result.returncode == 2 and message in result.stderr, result.stderr


@pytest.mark.slow
def test_a_benchmark_goes_through_the_whole_pipeline(tmp_path):
    """Recorded, trained in three ways, judged, watched and described, by the commands of the pages."""
    check_renderer()
    pytest.importorskip("metaworld")
    task, sizes = "mujoco:PlateSlide", ("--episodes", "3", "--eval_episodes", "2", "--workers", "1")
    recorded = run(tmp_path, "collect", "--task", task, *sizes)
    assert recorded.returncode == 0, recorded.stderr
    for recipe in ("decoupled", "joint", "end_to_end"):
        run_small(tmp_path, recipe, "--task", task, pictures=recipe == "decoupled")
        [file] = (tmp_path / "runs" / recipe / "plate_slide").glob("*/eval.json")
        result = json.loads(file.read_text())
        assert result["test_protocol"]["episodes"] == 3 and result["task"] == task
        assert "data:image/gif" in (file.with_name("report.html")).read_text() or recipe != "decoupled"
    policy = tmp_path / "runs/decoupled/plate_slide/position_velocity_recurrent"
    for options in (["--policy", policy], ["--policy", policy, "--delay", "3"], ["--task", task]):
        judged = run(tmp_path, "evaluate", *options, "--eval.episodes", "2")
        assert judged.returncode == 0, judged.stderr
    watched = run(
        tmp_path, "play", "--policy", policy, "--steps", "6", "--imagine_from", "3", "--gif", "film.gif"
    )
    assert watched.returncode == 0 and (tmp_path / "film.gif").exists(), watched.stderr
