from pathlib import Path

import pytest
import torch
from commands import run

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.experts.network import CHECKPOINTS, list_checkpoints
from dynmap_rl.modules.checkpoints import make_policy, make_world_model, save_policy, save_world_model
from dynmap_rl.utils.devices import Compute
from dynmap_rl.utils.files import read_json, write_json
from recipes.evaluate import Config, main

ONE_THREAD = "--compute.threads", "1"


def test_task_1s_expert_meets_the_obstacle_of_task_2(tmp_path, monkeypatch):
    """Named by its task or by its folder: it sees the state of the task that it was trained on."""
    arguments = [
        "--task",
        "balance_reaching_obstacle",
        "--expert",
        "balance_reaching",
        "--eval.episodes",
        "20",
    ]
    result = run(tmp_path, "evaluate", *arguments, "--eval.split", "validation", *ONE_THREAD)
    assert result.returncode == 0, result.stderr
    name = f"balance_reaching_obstacle_balance_reaching_{list_checkpoints('balance_reaching')[-1]}_validation_20_episodes"
    rates = read_json(tmp_path / f"runs/evaluate/{name}/eval.json")["rates"]
    assert 20 < rates["straight_path_blocked"] < 80
    assert rates["touched"] > 20
    assert rates["success"] + rates["touched"] <= 100
    assert f"{rates['touched']:5.1f} %" in result.stdout
    page = (tmp_path / "runs/evaluate" / name / "report.html").read_text()
    assert f"{rates['touched']:5.1f} %" in page and "data:image/gif" in page and "validation" in page

    monkeypatch.setattr("dynmap_rl.reporting.media.film", lambda *arguments, **options: None)
    folder, output = str(CHECKPOINTS / "balance_reaching"), tmp_path / "by_folder.json"
    task = "balance_reaching_obstacle"
    main(
        Config(
            task=task,
            expert=folder,
            eval=Evaluation("validation", 20, 0),
            compute=Compute(threads=1),
            output=output,
        )
    )
    again = read_json(output)
    assert again["rates"] == rates
    assert 100 * again["rows"]["success"].count("1") / len(again["rows"]["success"]) == rates["success"]


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


@pytest.mark.slow
def test_a_run_and_its_copy_for_lerobot_get_the_same_row(trained, tmp_path):
    common = "--eval.episodes", "3", "--eval.split", "validation", *ONE_THREAD
    result = run(tmp_path, "evaluate", "--policy", "trained", "--seed", "1", *common)
    assert result.returncode == 0, result.stderr
    ours = read_json(tmp_path / "runs/evaluate/bin_dropping_trained_seed_1_validation_3_episodes/eval.json")
    assert ours["rows"]["first_scene_seed"] == scene_seed("validation", 0)
    summary = ours["summary"]  # an untrained policy may well tip the block into the bin
    row = f"PE {summary['PE']:.1f} mm   SR {summary['SR']:.1f} %"
    page = (
        tmp_path / "runs/evaluate/bin_dropping_trained_seed_1_validation_3_episodes/report.html"
    ).read_text()
    assert row in result.stdout and row in page and "data:image/gif" in page

    lerobot = pytest.importorskip("dynmap_rl.integrations.lerobot")
    exported = lerobot.export_to_lerobot(trained, tmp_path / "exported", seed=1)
    output = tmp_path / "exported.json"
    result = run(tmp_path, "evaluate", "--policy", exported, "--output", output, *common)
    assert result.returncode == 0, result.stderr
    assert read_json(output)["rows"] == ours["rows"]


def test_the_shipped_policy_does_as_well_as_its_results_say(tmp_path):
    result = run(tmp_path, "evaluate", "--policy", "balance_reaching", "--eval.episodes", "4", *ONE_THREAD)
    assert result.returncode == 0, result.stderr
    ours = read_json(
        tmp_path / "runs/evaluate/balance_reaching_balance_reaching_seed_0_test_4_episodes/eval.json"
    )
    facts = read_json(
        Path(__file__).parents[2] / "recipes/results/measurements/pretrained_balance_reaching.json"
    )
    assert ours["rows"]["success"] == facts["rows"]["success"][:4]


def test_late_frames_bridged_or_stale(tmp_path, monkeypatch):
    monkeypatch.setattr("dynmap_rl.reporting.media.film_policy", lambda *arguments, **options: None)
    rows = {}
    for mode in ([], ["--stale"]):
        late = "--delay", "6", "--jitter", "2", "--lost", "0.1", *mode
        result = run(tmp_path, "evaluate", "--policy", "balance_reaching", "--eval.episodes", "2", *late)
        assert result.returncode == 0, result.stderr
        late = "delay_6_2_0.1_0", *(["stale"] if mode else []), "test_2_episodes"
        name = "_".join(["balance_reaching_balance_reaching_seed_0", *late])
        result = read_json(tmp_path / "runs/evaluate" / name / "eval.json")
        assert result["delay"] == {"steps": 6, "jitter": 2, "lost": 0.1, "error": 0} and result[
            "stale"
        ] is bool(mode)
        rows[bool(mode)] = result["rows"]
    assert rows[False]["first_scene_seed"] == rows[True]["first_scene_seed"]
    assert rows[False]["position_error"] != rows[True]["position_error"]


def test_numbers_are_written_before_the_film_and_another_file(tmp_path, monkeypatch):
    """Neither a film that cannot be drawn nor a file that cannot be written costs the evaluation."""

    def fail(*arguments, **options):
        raise OSError("no film")

    monkeypatch.chdir(tmp_path)
    few = {"eval": Evaluation("validation", 1, 0), "compute": Compute(threads=1)}
    with pytest.raises(IsADirectoryError):
        main(Config(policy="balance_reaching", output=tmp_path, **few))
    [result] = tmp_path.glob("runs/evaluate/*/eval.json")
    assert read_json(result)["episodes"] == 1
    result.unlink()
    monkeypatch.setattr("dynmap_rl.reporting.media.film_policy", fail)
    with pytest.raises(OSError, match="no film"):
        main(Config(policy="balance_reaching", output=tmp_path / "here.json", **few))
    assert read_json(tmp_path / "here.json") == read_json(result)


def test_a_page_that_cannot_be_written_is_an_error_before_the_evaluation(tmp_path, monkeypatch):
    (tmp_path / "runs").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dynmap_rl.evaluation.protocol.evaluate", None)
    with pytest.raises(OSError):
        main(Config(policy="balance_reaching"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--policy", "nothing"], "nothing"),
        (["--policy", "balance_reaching", "--seed", "7"], "seed_7"),
        (["--expert", "bin_dropping"], "bin_dropping"),
        (["--policy", "nothing", "--expert", "balance_reaching"], "--expert"),
        (["--expert", "nobody"], "nobody"),
        (["--expert", "balance_reaching", "--seed", "1"], "--seed"),
        (["--expert", "careless", "--checkpoint", "iteration_001"], "--checkpoint has no effect"),
        (["--expert", "careless", "--compute.device", "cuda"], "--compute.device has no effect"),
        (["--checkpoint", "iteration_999"], "iteration_999"),
        (["--eval.episodes", "0"], "episodes"),
        (["--eval.paper_episodes", "5"], "--eval.paper_episodes"),
        (["--eval.split", "holiday"], "holiday"),
        (["--delay", "6"], "--delay has no effect with an expert"),
        (["--policy", "balance_reaching", "--stale"], "--stale"),
        (["--policy", "balance_reaching", "--delay", "6", "--delay_error", "1", "--stale"], "--delay_error"),
        (["--policy", "balance_reaching", "--delay", "-1"], "steps must be at least 0"),
        (["--policy", "balance_reaching", "--jitter", "2"], "jitter must be at most the delay"),
        (
            ["--policy", "balance_reaching", "--delay", "2", "--delay_error", "-3"],
            "error must be at least -2",
        ),
        (["--policy", "balance_reaching", "--lost", "2"], "lost must be a probability"),
    ],
)
def test_bad_input_gets_one_clear_line(tmp_path, arguments, message):
    result = run(tmp_path, "evaluate", *arguments)
    assert result.returncode == 2
    assert message in result.stderr and "Traceback" not in result.stderr
    assert not any(tmp_path.iterdir())
