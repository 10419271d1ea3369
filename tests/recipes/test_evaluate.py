import os
import subprocess
import sys
from pathlib import Path

import pytest

from dynmap_rl.experts import list_checkpoints
from dynmap_rl.experts.policy import CHECKPOINTS
from dynmap_rl.runs import read_json
from recipes.evaluate import Config, main

ROOT = Path(__file__).parents[2]


def run(folder, *arguments):
    command = [sys.executable, str(ROOT / "recipes" / "evaluate.py"), *arguments]
    return subprocess.run(command, cwd=folder, env=os.environ, capture_output=True, text=True)


def test_task_1s_expert_meets_the_obstacle_of_task_2(tmp_path):
    """Named by its task or by its folder: it sees the state of the task that it was trained on."""
    arguments = ["--task", "balance_reaching_obstacle", "--expert", "balance_reaching", "--episodes", "30"]
    result = run(tmp_path, *arguments, "--split", "validation")
    assert result.returncode == 0, result.stderr
    name = f"balance_reaching_obstacle_balance_reaching_{list_checkpoints('balance_reaching')[-1]}_validation"
    rates = read_json(tmp_path / f"runs/evaluate/{name}.json")["rates"]
    assert 20 < rates["straight_path_blocked"] < 80
    assert rates["touched"] > 20
    assert rates["success"] + rates["touched"] <= 100
    assert f"{rates['touched']:5.1f} %" in result.stdout

    folder, output = str(CHECKPOINTS / "balance_reaching"), tmp_path / "by_folder.json"
    main(Config("balance_reaching_obstacle", folder, episodes=30, split="validation", output=output))
    assert read_json(output)["rates"] == rates


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--expert", "nobody"], "no expert at nobody"),
        (["--checkpoint", "iteration_999"], "choose from"),
        (["--episodes", "0"], "at least 1"),
        (["--split", "holiday"], "unknown split"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not any(tmp_path.iterdir())
