from pathlib import Path

import pytest
import torch
from commands import run

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.experts.network import list_checkpoints
from dynmap_rl.experts.network import CHECKPOINTS
from dynmap_rl.modules.checkpoints import make_policy
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.checkpoints import save_policy
from dynmap_rl.modules.checkpoints import save_world_model
from dynmap_rl.utils.files import read_json
from dynmap_rl.utils.files import write_json
from recipes.evaluate import Config, main


def test_task_1s_expert_meets_the_obstacle_of_task_2(tmp_path):
    """Named by its task or by its folder: it sees the state of the task that it was trained on."""
    arguments = ["--task", "balance_reaching_obstacle", "--expert", "balance_reaching", "--episodes", "30"]
    result = run(tmp_path, "evaluate", *arguments, "--split", "validation")
    assert result.returncode == 0, result.stderr
    name = f"balance_reaching_obstacle_balance_reaching_{list_checkpoints('balance_reaching')[-1]}_validation"
    rates = read_json(tmp_path / f"runs/evaluate/{name}/eval.json")["rates"]
    assert 20 < rates["straight_path_blocked"] < 80
    assert rates["touched"] > 20
    assert rates["success"] + rates["touched"] <= 100
    assert f"{rates['touched']:5.1f} %" in result.stdout
    page = (tmp_path / "runs/evaluate" / name / "report.html").read_text()
    assert f"{rates['touched']:5.1f} %" in page and "data:image/gif" in page and "validation" in page

    folder, output = str(CHECKPOINTS / "balance_reaching"), tmp_path / "by_folder.json"
    task = "balance_reaching_obstacle"
    main(Config(task=task, expert=folder, episodes=30, split="validation", output=output))
    assert read_json(output)["rates"] == rates


@pytest.fixture
def trained(recording, tmp_path):
    """What of a run of task 3 is needed, with a policy that was not trained."""
    folder, constants = tmp_path / "trained", load_meta(recording)["normalization"]
    torch.manual_seed(0)
    world_model = make_world_model(constants, ("position",))
    save_world_model(folder / "world_model", world_model)
    save_policy(folder / "seed_1/policy", make_policy(constants, "recurrent", world_model), world_model)
    write_json(folder / "config.json", {"task": "bin_dropping"})
    return folder


def test_a_run_and_its_copy_for_lerobot_get_the_same_row(trained, tmp_path):
    common = "--episodes", "3", "--split", "validation"
    result = run(tmp_path, "evaluate", "--policy", "trained", "--seed", "1", *common)
    assert result.returncode == 0, result.stderr
    ours = read_json(tmp_path / "runs/evaluate/bin_dropping_trained_seed_1_validation/eval.json")
    assert ours["rows"]["first_scene_seed"] == scene_seed("validation", 0)
    summary = ours["summary"]  # an untrained policy may well tip the block into the bin
    row = f"PE {summary['PE']:.1f} mm   SR {summary['SR']:.1f} %"
    page = (tmp_path / "runs/evaluate/bin_dropping_trained_seed_1_validation/report.html").read_text()
    assert row in result.stdout and row in page and "data:image/gif" in page

    lerobot = pytest.importorskip("dynmap_rl.integrations.lerobot")
    exported = lerobot.export_to_lerobot(trained, tmp_path / "exported", seed=1)
    output = tmp_path / "exported.json"
    result = run(tmp_path, "evaluate", "--policy", exported, "--output", output, *common)
    assert result.returncode == 0, result.stderr
    assert read_json(output)["rows"] == ours["rows"]


def test_the_shipped_policy_does_as_well_as_its_results_say(tmp_path):
    result = run(tmp_path, "evaluate", "--policy", "balance_reaching", "--episodes", "20")
    assert result.returncode == 0, result.stderr
    ours = read_json(tmp_path / "runs/evaluate/balance_reaching_balance_reaching_seed_0_test/eval.json")
    facts = read_json(Path(__file__).parents[2] / "recipes/results/pretrained_balance_reaching.json")
    assert ours["rows"]["success"] == facts["rows"]["success"][:20]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nothing"], "there is no policy at nothing"),
        (["--policy", "balance_reaching", "--seed", "7"], "holds no checkpoint"),
        (["--expert", "bin_dropping"], "sees states of bin_dropping, which balance_reaching does not have"),
        (["--policy", "nothing", "--expert", "balance_reaching"], "name one of them"),
        (["--expert", "nobody"], "no expert at nobody"),
        (["--checkpoint", "iteration_999"], "choose from"),
        (["--episodes", "0"], "at least 1"),
        (["--split", "holiday"], "unknown split"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, "evaluate", *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not any(tmp_path.iterdir())
