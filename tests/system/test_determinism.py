"""The same command gives the same metrics, results and weights, to the last bit, for every recipe that trains."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import place_recordings, run_small
from stress.kills import contents

pytestmark = pytest.mark.slow
SOURCE = "--pretrained runs/decoupled/balance_reaching/none_recurrent"
TASKS = "balance_reaching", "bin_dropping"
RECIPES = {
    "decoupled": "--world_model.supervision none --seeds 0,1",
    "joint": "",
    "end_to_end": "",
    "generalize": f"--task bin_dropping {SOURCE}",
    "expert": "",
    "latent_ppo": SOURCE,
}


def run_all(folder):
    for recipe, arguments in RECIPES.items():
        run_small(folder, recipe, *arguments.split())


@pytest.fixture(scope="module")
def twice(tmp_path_factory, recordings):
    """Return two folders in which every recipe ran: here, and in a process with another seed for Python's hashes."""
    folders = [tmp_path_factory.mktemp("twice") for _ in range(2)]
    for folder in folders:
        place_recordings(folder, recordings, *TASKS)
    run_all(folders[0])
    code = "import sys; sys.path[:0] = sys.argv[2:]; import test_determinism as t; t.run_all(t.Path(sys.argv[1]))"
    paths = Path(__file__).parents[2], Path(__file__).parents[1], Path(__file__).parent
    command = [sys.executable, "-c", code, folders[1], *paths]
    result = subprocess.run(
        command, env={**os.environ, "PYTHONHASHSEED": "1"}, capture_output=True, text=True
    )
    assert result.returncode == 0, result.stderr
    return folders


@pytest.mark.parametrize("recipe", RECIPES)
def test_the_same_command_gives_the_same(twice, recipe):
    first, second = (contents(folder / "runs" / recipe) for folder in twice)
    assert any(name.endswith("metrics.jsonl") for name in first)
    assert any(name.endswith(".safetensors") for name in first)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []


def test_another_seed_gives_other_metrics(twice):
    run_small(twice[0], "end_to_end", "--seeds", "1", "--run", "runs/other")
    first = contents(twice[0] / "runs/end_to_end")
    other = contents(twice[0] / "runs/other")
    [metrics] = [first[name] for name in first if name.endswith("seed_0/metrics.jsonl")]
    assert metrics != other["seed_1/metrics.jsonl"]
