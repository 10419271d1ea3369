"""The installed package, away from its source: it ships weights and experts, and the recipes run on it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import PRESETS

pytestmark = pytest.mark.slow

RECIPES = Path(__file__).parents[2] / "recipes"
CODE = """
import dynmap_rl
from dynmap_rl.envs.tasks import TASKS
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.runs import load_actor
print(dynmap_rl.__file__, load_actor("balance_reaching").policy.width, [len(list_checkpoints(task)) for task in TASKS])
"""

LEARN = """
import sys
import gymnasium
from stable_baselines3 import PPO
assert "dynmap_rl" not in sys.modules
model = PPO("MlpPolicy", gymnasium.make("dynmap_rl:dynmap_rl/BalanceReaching-v1", obs_type="state"), n_steps=64)
print(model.learn(64).num_timesteps, sys.modules["dynmap_rl"].__file__)
"""


@pytest.fixture
def python(installed, tmp_path):
    """Return a function that runs Python on the installed package in an empty folder."""

    def run(*arguments):
        environment = os.environ | {"PYTHONPATH": str(installed), "TQDM_DISABLE": "1"}
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_weights_and_experts_are_in_the_wheel(python, installed):
    file, *others = python("-c", CODE).split()
    assert Path(file).is_relative_to(installed)
    assert others == ["128", "[5,", "4,", "4]"]


def test_recipes_run_on_it(python, recording, tmp_path):
    shutil.copytree(RECIPES, tmp_path / "mine", ignore=shutil.ignore_patterns("results", "__pycache__"))
    assert "SR 100.0 %" in python("mine/evaluate.py", "--policy", "balance_reaching", "--eval.episodes", 2)
    assert "PPO on latents" in python(
        "mine/latent_ppo.py", "--config_path", PRESETS / "latent_ppo.yaml", "--pretrained", "balance_reaching"
    )
    python("mine/collect.py", "--episodes", 1, "--eval_episodes", 1, "--workers", 1, "--output", "mine/data")
    state = "--state", "dynamics.position", "--angles", "2,5", "--replace"
    assert "written: derived" in python(
        "mine/add_dynamics.py", "--dataset", "mine/data", *state, "--output", "derived"
    )


def test_stable_baselines_learns_on_its_id(python, installed):
    pytest.importorskip("stable_baselines3")
    steps, file = python("-c", LEARN).split()
    assert steps == "64" and Path(file).is_relative_to(installed)
