"""Every benchmark runs in a minimal size, and the page holds the stored numbers."""

import importlib
import math
import multiprocessing
import os
import subprocess
from pathlib import Path

import commands
import pytest
import torch
from own_task import check_renderer
from stress import kills

from dynmap_rl.data import load_dataset, load_meta, record_dataset, sample_windows
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.objectives.world_model import WorldModelLoss
from dynmap_rl.utils.cli import parse_settings, read_arguments
from dynmap_rl.utils.files import read_json, write_json

SMALL = {
    "control_step": {},
    "frame": {},
    "pusht": {},
    "batch": {"num_envs": 2, "steps": 2},
    "processes": {"num_envs": 2, "steps": 2, "amount": 100},
    "ppo": {"seeds": (0,), "iterations": 2, "num_envs": 2, "episodes": 2},
    "training": {"count": 2, "steps": 4, "updates": 1},
    "training_decode_8": {"count": 2, "steps": 10, "updates": 1},
    "windows": {"batches": 1},
    "to_tensordict": {"count": 10},
    "evaluation": {"episodes": 2, "single": 1},
    "recording": {"episodes": 1},
    "evaluating": {"episodes": 2},
    "ranks": {"updates": (1, 2), "repeats": 1},
    "onnx": {"steps": 2},
    "import": {},
    "help": {"pattern": "paper/tables.py"},
}


@pytest.fixture
def load(monkeypatch):
    """Return a function from the name of a benchmark to its module."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return importlib.import_module


@pytest.mark.stress
def test_the_plain_world_model_is_the_same_model(load, recording):
    """Loss and gradients, in float32 and with every frame decoded."""
    torch.manual_seed(0)
    windows = sample_windows(load_dataset(recording, "train"), 2, 5, torch.Generator().manual_seed(0))
    model = make_world_model(load_meta(recording)["normalization"], DYNAMICS, architecture="plain")
    plain = load("learning").PlainWorldModel(model)
    ours, theirs = sum(WorldModelLoss(model)(windows).values()), plain.loss(windows, None)
    torch.testing.assert_close(theirs, ours, rtol=1e-5, atol=0)
    shared = [p for name, p in model.named_parameters() if "lstm" not in name]
    lstm = [p for name, p in model.named_parameters() if "lstm" in name]
    ours, theirs = (
        torch.autograd.grad(loss, [*shared, *own])
        for loss, own in ((ours, lstm), (theirs, plain.cells.parameters()))
    )
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-6)


@pytest.mark.stress
@pytest.mark.parametrize("row", SMALL)
@pytest.mark.filterwarnings("ignore:.*use of fork", "ignore:You have specified a mini-batch size")
def test_every_row_runs(load, recording, tmp_path, monkeypatch, row):
    """Once, in a minimal size, and without processes that import everything again."""

    def compare(ours, theirs, repeats=1, warm=False):
        a, b = ours(), theirs()
        return {"ours": a, "theirs": b, "ratio": a / b}

    def run_here(command, **_):
        assert commands.run(tmp_path, "expert", *command[2:]).returncode == 0

    if row == "pusht" and "PUSHT_PYTHON" not in os.environ:
        pytest.skip("gym-pusht needs an environment of its own")
    if row == "processes":
        context = multiprocessing.get_context("fork")
        monkeypatch.setattr(multiprocessing, "get_context", lambda method: context)
    if row == "onnx":
        for name in ("onnx", "onnxruntime", "onnxscript"):
            pytest.importorskip(name, reason="needs the extra onnx")
    if row == "ppo":
        pytest.importorskip("stable_baselines3")
        monkeypatch.setattr(load("ppo"), "GOAL", 0.0)
        monkeypatch.setattr(subprocess, "run", run_here)
    for name in ("deploying", "learning", "loading", "parallel", "ranks", "simulation", "starting"):
        monkeypatch.setattr(load(name), "compare", compare)
    run = load("run")
    monkeypatch.setattr(run, "DATASET", str(recording))
    threads = torch.get_num_threads()
    try:
        found = run.ROWS[row][-1](**SMALL[row])
    finally:
        torch.set_num_threads(threads)
    assert all(0 < found[key] < math.inf for key in ("ours", "theirs", "ratio"))
    assert len(run.speed_table({"rows": {row: found}}).splitlines()) == 3, "the head and the row"


def test_every_row_is_tried(load):
    assert set(load("run").ROWS) == set(SMALL)


def test_the_page_holds_the_stored_numbers(load):
    run = load("run")
    text = run.PAGE.read_text()
    assert run.page(text) == text, "python tests/benchmarks/run.py --write"
    assert run.page(text.replace("**", "")) == text


def test_the_plan_follows_from_the_stored_numbers(load, tmp_path):
    planning = load("planning")
    text = planning.PAGE.read_text()
    assert planning.page(text) == text, "python tests/benchmarks/planning.py"
    size = {
        "episodes": 100,
        "files_MB": 3,
        "cache_MB": 150,
        "cold": {"load_s": 2},
        "warm": {"private_MB": 400},
    }
    write_json(tmp_path / "dataset_size.json", {"rows": {"100": size}})
    rate = {"device": "here", "threads": 2, "rows": [{"frames_per_s": 1000}]}
    write_json(tmp_path / "updates_cpu.json", rate)
    write_json(tmp_path / "benchmarks.json", {"rows": {"recording": {"episodes": 100, "theirs": 18}}})
    prices = planning.Prices(core_hour=0.1, gb_month=0.01)
    needs = planning.list_needs(tmp_path, 1_000_000, prices)
    text = " ".join(need for need, _ in needs.values())
    assert [word in text for word in ("50 hours", "30 GB", "1,500 GB", "5.6 hours", "33 hours")] == [True] * 5
    costs = {need.split(",")[0]: cost for need, (_, cost) in needs.items()}
    assert costs["recording"] == pytest.approx(5)
    assert costs["decoded frames"] == pytest.approx(15)
    assert costs["training"] == pytest.approx(33.33 * 2 * 0.1, rel=1e-3)


def test_commands_of_other_scripts_are_understood(load):
    """The commands run for hours; here only their options are parsed."""
    listed = [(name, arguments.split()) for name, arguments in kills.COMMANDS.items()]
    for recipe, arguments in [*load("memory").COMMANDS.items(), *listed]:
        config_class = importlib.import_module(f"recipes.{recipe.replace('/', '.')}").Config
        parse_settings(config_class, read_arguments(arguments, config_class))


@pytest.mark.slow
@pytest.mark.parametrize("enlarge", [False, True])
def test_datasets_are_tiled(load, recording, tmp_path, enlarge):
    size = load("dataset_size")
    root = tmp_path / "tiled"
    size.tile(recording, root, 9, enlarge)
    source, tiled = load_dataset(recording), load_dataset(root)
    assert torch.equal(tiled["action"], torch.cat([source["action"], source["action"][:3]]))
    cameras = [tiled["pixels"]] if not enlarge else tiled["pixels"][..., ::2, ::2].split(64, -1)
    assert all(torch.equal(frames[6:], source["pixels"][:3]) for frames in cameras)
    row = size.measure(root, in_memory=True)
    assert all(value > 0 for value in row.values())


@pytest.mark.slow
def test_updates_are_measured(load):
    updates, cpu = load("updates"), torch.device("cpu")
    peak = updates.convolution_peak(cpu, mixed=False, repeats=1)
    row = updates.measure(cpu, 2, mixed=False, compiled=False, repeats=1, peak=peak)
    assert 0 < row["share_of_convolution_peak"] < 1 and row["frames_per_s"] > 0
    assert sum(row["breakdown"].values()) == pytest.approx(1) and row["breakdown"]["convolution"] > 0


@pytest.mark.slow
def test_errors_of_derived_dynamics_grow_with_noise(load, recording, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "sys.argv",
        ["x.py", "--datasets", str(recording), "--episodes", "2", "--output", str(tmp_path / "found.json")],
    )
    load("derivatives").main()
    found = read_json(tmp_path / "found.json")[recording.name]
    errors = [found["state"][f"savgol, {noise} mm"]["velocity"]["linear"] for noise in (0, 2, 5, 10)]
    assert errors == sorted(errors) and found["state"]["central, 0 mm"]["position"]["linear"] == 0
    assert found["frames"]["tracks, savgol"]["position"]["linear"] < 15 and found["episodes"] == 2


@pytest.mark.slow
def test_tracks_are_nearer_to_the_box_with_its_colour(load, tmp_path, monkeypatch):
    check_renderer()
    pytest.importorskip("gymnasium_robotics")
    record_dataset(tmp_path / "few", "mujoco:FetchPush", episodes=2, eval_episodes=1, workers=1)
    arguments = ["--recording", str(tmp_path / "few"), "--output", str(tmp_path / "found.json")]
    monkeypatch.setattr("sys.argv", ["x.py", *arguments])
    load("tracks3d").main()
    found = read_json(tmp_path / "found.json")["median_distance_mm"]
    assert found["RGB+[P+V], hand and color"]["object1"]["object"] < 20
    assert len(found["RGB+[P+V], tracked"]) == 2


@pytest.mark.slow
def test_recording_is_compared_with_the_benchmarks_own_rendering(load, tmp_path, monkeypatch):
    check_renderer()
    pytest.importorskip("gymnasium_robotics")
    output = tmp_path / "found.json"
    arguments = ["--tasks", "FetchPush", "--episodes", "1", "--frames", "2", "--output", str(output)]
    monkeypatch.setattr("sys.argv", ["x.py", *arguments])
    load("recording3d").main()
    row = read_json(output)["tasks"]["FetchPush"]
    assert all(row[who][time] > 0 for who in ("ours", "lerobot", "theirs") for time in ("cpu", "clock"))


@pytest.mark.slow
def test_loops_in_real_time(load):
    """With and without sleeping, with a policy in the loop and in a slow process."""
    realtime = load("realtime")
    actor = realtime.load_actor("balance_reaching")
    late = realtime.measure(realtime.Local(realtime.DelayedActor(actor, delay=2), delay=2), 125, paced=False)
    assert late["episodes"] >= 1 and 0 < late["latency_ms"]["p50"] <= late["latency_ms"]["worst"]
    server = realtime.Server(delay=4, size=30, work=0.15)
    row = realtime.measure(server, 20, paced=True)
    server.close()
    assert row["steps"] == 20 and server.ages and max(server.ages) > 0
