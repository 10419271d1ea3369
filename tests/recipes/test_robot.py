"""Training on a robot dataset as a command, decoupled and jointly."""

import shutil

import pytest
import torch
from commands import PRESETS, run, run_small
from robot_dataset import make_robot_dataset

from dynmap_rl.data.derive import add_dynamics
from dynmap_rl.modules.checkpoints import load_policy, load_world_model
from dynmap_rl.runs.folder import read_metrics
from dynmap_rl.training.settings import PolicyTraining, WorldModelTraining
from dynmap_rl.utils.files import read_json


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """Return a folder with ``gliding``, which has dynamics, and ``plain``, which has none."""
    root = tmp_path_factory.mktemp("robot")
    make_robot_dataset(root / "plain", (20, 14, 25))
    add_dynamics(root / "plain", root / "gliding", columns=[0, 1, 2], angles=[2])
    return root


JOINT = ["--method", "joint", "--goal", "observation.state:0,1", "--policy.kind", "feedforward"]
UNDO = [  # sizes of the preset that have no effect in joint training
    *(
        f"--world_model.{n}={getattr(WorldModelTraining(), n)}"
        for n in ("updates", "windows", "window_steps", "rgb_frames")
    ),
    *(f"--policy.{n}={getattr(PolicyTraining(), n)}" for n in ("updates", "batch")),
]
SIZES = ["--joint.updates=4", "--joint.windows=2", "--joint.window_steps=6", "--joint.rgb_frames=2"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "arguments", "goal"), [("decoupled", [], 0), ("joint", JOINT + UNDO + SIZES, 2)]
)
def test_a_run_measures_held_out_errors(datasets, tmp_path, method, arguments, goal):
    dataset = shutil.copytree(datasets / "gliding", tmp_path / "gliding")
    arguments = "--dataset", dataset, *arguments
    result = run_small(tmp_path, "robot", *arguments)
    assert "RGB+[P+V], " in result.stdout
    [folder] = (tmp_path / "runs/robot/gliding").iterdir()
    evaluation = read_json(folder / "eval.json")
    held_out = evaluation["held_out"]
    assert held_out.keys() == {"rgb", "imitation_l1", "position", "velocity", "action"}
    assert held_out["velocity"].keys() == {"x", "y", "angle"} and held_out["action"].keys() == {"vx", "vy"}
    assert evaluation["spread"].keys() == {"position", "velocity", "action"}
    assert evaluation["trained_on"]["held_out_episodes"] == [2]
    assert evaluation["judged"]["verdict"] in ("good", "doubtful") and "world model: " in result.stdout
    assert "held out: episodes 2" in result.stdout
    assert evaluation["world_model"] == {"training": method, "dataset": str(dataset)}
    settings = evaluation["settings"]["joint" if method == "joint" else "world_model"]
    assert settings["augmentation"] == {"recolor": False, "mirror": False, "max_shift": 0}
    assert evaluation["settings"]["policy"]["emphasis"] == 0, "the preset sets other options of that group"
    metrics = read_metrics(folder if method == "decoupled" else folder / "seed_0")[-1]
    assert metrics["error_velocity_2"] > 0 and "error_velocity_angle" not in metrics

    world_model, policy = load_world_model(folder / "world_model"), load_policy(folder / "seed_0/policy")
    latent, hidden1, hidden2 = torch.zeros(1, 2, 64), *torch.zeros(2, 1, 2, 128)
    assert policy(latent, hidden1, hidden2, torch.zeros(1, 2, goal)).shape == (1, 2, 2)
    assert world_model.decode_dynamics(latent, hidden1, hidden2)["position"].shape == (1, 2, 3)
    again = run_small(tmp_path, "robot", *arguments)
    assert "complete" in again.stdout and result.stdout.split("\n")[1] in again.stdout

    shutil.rmtree(dataset)
    add_dynamics(datasets / "plain", dataset, columns=[1, 0, 2], angles=[2])
    other = run(tmp_path, "robot", "--config_path", PRESETS / "robot.yaml", *arguments)
    assert other.returncode == 2 and "other data than" in other.stderr

    closed_loop = run(tmp_path, "evaluate", "--policy", folder)
    assert closed_loop.returncode == 2 and "gliding" in closed_loop.stderr, "there is no simulator"


@pytest.mark.slow
def test_a_dataset_without_dynamics_trains_on_its_frames_in_permuted_colours(datasets, tmp_path):
    options = "--world_model.supervision", "none", "--world_model.augmentation.recolor", "true"
    run_small(tmp_path, "robot", "--dataset", datasets / "plain", *options)
    [folder] = (tmp_path / "runs/robot/plain").iterdir()
    assert read_json(folder / "eval.json")["held_out"].keys() == {"rgb", "imitation_l1", "action"}
    assert (folder / "figures/reconstruction.png").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--dataset must"),
        (["--dataset", "gliding", "--world_model.augmentation.mirror", "true"], "no known mirror image"),
        (["--dataset", "plain"], "dynamics.position"),
        (["--dataset", "gliding", "--camera", "front"], "observation.images.top"),
        (["--dataset", "gliding", "--goal", "observation.state:9"], "observation.state"),
        (["--dataset", "gliding", "--method", "end_to_end"], "--method must"),
        (
            ["--dataset", "gliding", "--joint.updates", "3"],
            "--joint.updates has no effect with --method decoupled",
        ),
        (
            ["--dataset", "gliding", "--method", "joint", "--policy.corrections", "1"],
            "--policy.corrections has no effect",
        ),
        (
            ["--dataset", "gliding", "--image_size", "72", "--world_model.architecture", "vit"],
            "must be a multiple of 32, got 72",
        ),
        (
            [
                "--dataset=gliding",
                "--method=joint",
                "--world_model.supervision=none",
                "--joint.beta_dynamics=2",
            ],
            "--joint.beta_dynamics has no effect",
        ),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(datasets, arguments, message):
    before = sorted(datasets.rglob("*"))
    result = run(datasets, "robot", *arguments)
    assert result.returncode == 2 and message in result.stderr
    assert sorted(datasets.rglob("*")) == before
