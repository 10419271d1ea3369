"""Decoupled and joint training on a dataset of no task of ours, as commands on the installed package."""

from pathlib import Path

import pytest
import torch
from foreign_dataset import make_foreign

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.modules.checkpoints import load_policy
from dynmap_rl.modules.checkpoints import load_world_model
from dynmap_rl.utils.files import read_json
from dynmap_rl.runs.folder import read_metrics

RECIPES = Path(__file__).parents[2] / "recipes"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("foreign")
    make_foreign(root / "plain", (20, 14, 25))
    add_dynamics(root / "plain", root / "gliding", columns=[0, 1, 2], angles=[2])
    return root / "gliding"


@pytest.mark.parametrize(
    ("recipe", "arguments", "goal"),
    [("decoupled", [], 0), ("joint", ["--goal", "observation.state:0,1", "--policy", "feedforward"], 2)],
)
def test_smoke_run_holds_held_out_errors(command, dataset, tmp_path, recipe, arguments, goal):
    words = RECIPES / f"{recipe}.py", "--task", "none", "--smoke", "--dataset", dataset, *arguments
    result = command(tmp_path, *words)
    assert result.returncode == 0, result.stderr
    assert "RGB+[P+V], " in result.stdout and "no closed loop" in result.stdout
    [folder] = (tmp_path / "runs" / recipe / "gliding").iterdir()
    evaluation = read_json(folder / "eval.json")
    held_out = evaluation["held_out"]
    assert held_out.keys() == {"rgb", "imitation_l1", "position", "velocity", "action"}
    assert held_out["velocity"].keys() == {"x", "y", "angle"} and held_out["action"].keys() == {"vx", "vy"}
    assert evaluation["spread"].keys() == {"position", "velocity", "action"}
    assert evaluation["trained_on"]["held_out_episodes"] == [2]
    assert evaluation["world_model"] == {"task": "none", "training": recipe, "dataset": str(dataset)}
    assert (evaluation["settings"]["emphasis"], evaluation["settings"]["distractors"]) == (0, 0)
    metrics = read_metrics(folder if recipe == "decoupled" else folder / "seed_0")[-1]
    assert metrics["error_velocity_2"] > 0 and "error_velocity_angle" not in metrics

    world_model, policy = load_world_model(folder / "world_model"), load_policy(folder / "seed_0/policy")
    latent, hidden1, hidden2 = torch.zeros(1, 2, 64), *torch.zeros(2, 1, 2, 128)
    assert policy(latent, hidden1, hidden2, torch.zeros(1, 2, goal)).shape == (1, 2, 2)
    assert world_model.decode_dynamics(latent, hidden1, hidden2)["position"].shape == (1, 2, 3)
    assert "what the world model predicted from the frame before" in (folder / "report.html").read_text()
    again = command(tmp_path, *words)
    assert "is done" in again.stdout and result.stdout.split("\n")[1] in again.stdout


@pytest.mark.parametrize(
    ("recipe", "settings", "message"),
    [
        ("decoupled", {"dataset": None}, "--task none needs a --dataset"),
        (
            "decoupled",
            {"dataset": "plain"},
            "has no dynamics.position, dynamics.velocity; give it dynamics with",
        ),
        ("joint", {"camera": "front"}, "has no camera 'front'; choose --camera from observation.images.top"),
        ("joint", {"goal": "observation.state:9"}, "has the entries 0 to 3"),
        ("decoupled", {"task": "balance_reaching", "goal": "observation.state:0"}, "are for --task none"),
        ("end_to_end", {}, "unknown task 'none'"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(dataset, tmp_path, recipe, settings, message):
    import importlib

    module = importlib.import_module(f"recipes.{recipe}")
    settings = {"task": "none", "dataset": str(dataset), "run": tmp_path / "bad"} | settings
    if settings["dataset"] == "plain":
        settings["dataset"] = str(dataset.with_name("plain"))
    with pytest.raises(ValueError, match=message):
        module.main(module.Config(**settings))
    assert not any(tmp_path.iterdir())


def test_a_world_model_of_another_dataset_is_refused(dataset, tmp_path):
    from recipes.decoupled import Config, main

    main(Config(task="none", dataset=str(dataset), run=tmp_path / "run", smoke=True, threads=1))
    other = str(dataset.with_name("plain"))
    settings = {"task": "none", "smoke": True, "world_model": tmp_path / "run", "run": tmp_path / "bad"}
    main(Config(dataset=str(dataset), policy="feedforward", **settings | {"run": tmp_path / "second"}))
    with pytest.raises(ValueError, match=f"is a world model of {dataset}, decoupled"):
        main(Config(dataset=other, supervision="none", **settings))
