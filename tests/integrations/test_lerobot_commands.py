"""LeRobot's commands on the installed wheels, whose plugin LeRobot finds.

One command runs as a process of its own; the others share a process, since importing LeRobot takes long.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from commands import run
from own_task import check_renderer
from safetensors.torch import load_file

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.keys import GYMNASIUM_IDS

pytestmark = pytest.mark.slow

PLUGIN = "discover_packages_path=dynmap_rl.integrations.lerobot"
TASKS = tuple(GYMNASIUM_IDS)
QUICK = ["--batch_size=2", "--log_freq=1", "--num_workers=0", "--env_eval_freq=0"]
SMALL = {
    "dynmap": ["--policy.window_steps=6", "--policy.rgb_frames=2"],
    "act": [
        "--policy.pretrained_backbone_weights=null",
        "--policy.dim_model=16",
        "--policy.n_heads=2",
        "--policy.dim_feedforward=16",
        "--policy.n_encoder_layers=1",
        "--policy.n_vae_encoder_layers=1",
        "--policy.chunk_size=30",
        "--policy.n_action_steps=30",
    ],
    "diffusion": [
        "--policy.pretrained_backbone_weights=null",
        "--policy.down_dims=[16,32]",
        "--policy.horizon=32",
        "--policy.n_action_steps=30",
        "--policy.num_inference_steps=1",
    ],
}


@pytest.fixture
def lerobot(command, tmp_path):
    """Return a function that runs ``lerobot-NAME`` and returns its output."""

    def run(name, *arguments, code=0):
        done = command(tmp_path, Path(sys.executable).with_name(f"lerobot-{name}"), *arguments)
        assert done.returncode == code, done.stderr[-3000:]
        return done.stderr + done.stdout

    return run


def train_arguments(kind, dataset, output, steps):
    return [
        f"--policy.type={kind}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        *SMALL[kind],
        "--dataset.repo_id=user/small",
        f"--dataset.root={dataset}",
        "--dataset.use_imagenet_stats=false",
        f"--output_dir={output}",
        f"--steps={steps}",
        *QUICK,
    ]


def evaluate(lerobot, path, task, output):
    lerobot(
        "eval",
        f"--env.{PLUGIN}",
        f"--policy.path={path}",
        "--policy.device=cpu",
        "--env.type=dynmap",
        f"--env.task={task}",
        "--eval.n_episodes=1",
        "--eval.batch_size=1",
        "--seed=3",
        f"--output_dir={output}",
    )
    return json.loads((output / "eval_info.json").read_text())


@pytest.fixture(scope="module")
def trained(recording, installed, tmp_path_factory):
    """Return folder and output of four steps of ``lerobot-train``, with two checkpoints and an evaluation at the end."""
    output = tmp_path_factory.mktemp("lerobot") / "train"
    command = [Path(sys.executable).with_name("lerobot-train"), "--save_freq=2"]
    command += [*train_arguments("dynmap", recording, output, 4), "--env.type=dynmap"]
    command += ["--env_eval_freq=4", "--eval.n_episodes=1", "--eval.batch_size=1", "--env.split=validation"]
    # Nothing random in a step: LeRobot restores torch's generator, but then draws from it for its loader.
    command += ["--policy.recolor=false", "--policy.symmetric=false", "--policy.rgb_frames=12"]
    environment = os.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(installed)}
    done = subprocess.run(
        command, cwd=output.parent, env=environment, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return output, done.stderr + done.stdout


def test_train_supervises_on_the_dynamics(trained):
    output, printed = trained
    for term in ("rgb", "latent", "position", "velocity", "policy"):
        assert f"loss_{term}:" in printed
    assert "pc_success" in printed
    names = {path.name for path in (output / "checkpoints/last/pretrained_model").iterdir()}
    assert {"config.json", "model.safetensors", "policy_preprocessor.json"} <= names


def test_resuming_gives_the_weights_of_the_uninterrupted_run(trained, lerobot):
    output, _ = trained
    path = output / "checkpoints/000004/pretrained_model/model.safetensors"
    whole = load_file(path)
    path.unlink()
    config = output / "checkpoints/000002/pretrained_model/train_config.json"
    lerobot("train", f"--policy.{PLUGIN}", f"--config_path={config}", "--resume=true")
    resumed = load_file(path)
    assert whole.keys() == resumed.keys()
    for name, value in whole.items():
        torch.testing.assert_close(resumed[name], value, rtol=0, atol=1e-6)


@pytest.mark.parametrize("task", TASKS)
def test_eval_runs_the_policy(trained, lerobot, tmp_path, task):
    info = evaluate(lerobot, trained[0] / "checkpoints/last/pretrained_model", task, tmp_path / "eval")
    assert info["overall"]["n_episodes"] == 1
    assert info["overall"]["pc_success"] == 0.0
    (video,) = info["overall"]["video_paths"]
    assert Path(video).stat().st_size > 1000


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_policies_of_lerobot_train_on_the_datasets_and_act_in_the_tasks(kind, recording, lerobot, tmp_path):
    output = tmp_path / "train"
    lerobot("train", *train_arguments(kind, recording, output, 1))
    for task in TASKS:
        info = evaluate(lerobot, output / "checkpoints/last/pretrained_model", task, tmp_path / task)
        assert info["overall"]["n_episodes"] == 1


def test_edited_datasets_stay_datasets_that_can_be_trained_on(recording, lerobot, tmp_path):
    common = ["--repo_id=user/small", f"--root={recording}", "--new_repo_id=user/edited"]
    edited = tmp_path / "edited"
    operation = ["--operation.type=delete_episodes", "--operation.episode_indices=[0, 3]"]
    lerobot("edit-dataset", *common, f"--new_root={edited}", *operation)
    kept = load_dataset(recording)[[1, 2, 4, 5]]
    after = load_dataset(edited)
    for key in ("pixels", "agent_pos", "action", "dynamics", "disturbed"):
        assert (after[key] == kept[key]).all()
    lerobot("train", *train_arguments("dynmap", edited, tmp_path / "train", 1))

    bare = tmp_path / "bare"
    operation = ["--operation.type=remove_feature", "--operation.feature_names=['dynamics.velocity']"]
    lerobot("edit-dataset", *common, f"--new_root={bare}", *operation)
    printed = lerobot("train", *train_arguments("dynmap", bare, tmp_path / "bare_train", 1), code=1)
    assert "must have the columns dynamics.velocity" in printed


def test_viewer_takes_an_episode(recording, lerobot, tmp_path):
    pytest.importorskip("rerun")
    arguments = ["--repo-id=user/small", f"--root={recording}", "--episode-index=1", "--num-workers=0"]
    lerobot("dataset-viz", *arguments, "--save=1", f"--output-dir={tmp_path}")
    assert (tmp_path / "user_small_episode_1.rrd").stat().st_size > 10_000


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_policies_of_lerobot_learn_a_benchmark(kind, lerobot, tmp_path):
    """By commands on the installed plugin; two cameras and larger frames."""
    check_renderer()
    pytest.importorskip("metaworld")
    task = "mujoco:PlateSlide:image_size=96,cameras=2"
    sizes = "--episodes", "2", "--eval_episodes", "1", "--workers", "1", "--output", "recorded"
    assert run(tmp_path, "collect", "--task", task, *sizes).returncode == 0
    lerobot("train", *train_arguments(kind, tmp_path / "recorded", tmp_path / "train", 1))
    path = tmp_path / "train/checkpoints/last/pretrained_model"
    info = evaluate(lerobot, path, task, tmp_path / "eval")
    assert info["overall"]["n_episodes"] == 1
    judged = run(tmp_path, "evaluate", "--policy", path, "--task", task, "--eval.episodes", "2")
    assert judged.returncode == 0, judged.stderr


def test_lerobot_finds_the_environment_by_itself(command, tmp_path):
    script = tmp_path / "find.py"
    script.write_text(
        "from lerobot.utils.import_utils import register_third_party_plugins\n"
        "import importlib.metadata, json, sys\n"
        "names = [d.metadata['Name'] for d in importlib.metadata.distributions()]\n"
        "register_third_party_plugins()\n"
        "from lerobot.envs import make_env_config\n"
        "make_env_config('dynmap', task='my_own_tasks:Mine')  # beside which the command runs\n"
        "config = make_env_config('dynmap', task='balance_reaching')\n"
        "print(json.dumps(['lerobot_env_dynmap' in names, 'lerobot_env_dynmap' in sys.modules, config.fps]))\n"
    )
    (tmp_path / "here").mkdir()
    (tmp_path / "here/my_own_tasks.py").write_text(
        "from dynmap_rl.envs.tasks import BalanceReaching\n\n\nclass Mine(BalanceReaching):\n    name = 'mine'\n"
    )
    done = command(tmp_path / "here", script)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == [True, True, 20]
