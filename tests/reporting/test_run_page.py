"""Results of runs: their content, their text, and results of different world models."""

import numpy as np
import pytest
import torch
from small import CONSTANTS, make_episodes, make_model

from dynmap_rl.evaluation.protocol import judge_in_closed_loop, unpack_rows
from dynmap_rl.evaluation.settings import Evaluation
from dynmap_rl.evaluation.statistics import shared_interval, summarize
from dynmap_rl.modules.checkpoints import make_policy, save_policy
from dynmap_rl.reporting.run_page import row_text, write_report
from dynmap_rl.runs.folder import append_metrics
from dynmap_rl.utils.files import read_json, write_json

PUBLISHED = {"SR": (89.0, 0.9)}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run folder with two policies, and its world model."""
    folder, model = tmp_path_factory.mktemp("run"), make_model().eval()
    for seed, paper_episodes in ((0, 1), (1, 1)):
        torch.manual_seed(seed)
        policy = make_policy(CONSTANTS, "feedforward", model, width=8)
        save_policy(folder / f"seed_{seed}/policy", policy, model)
        result = judge_in_closed_loop(
            model, policy, "balance_reaching", Evaluation("validation", 2, paper_episodes)
        )
        write_json(folder / f"seed_{seed}/eval.json", result | {"world_model_sha256": "one"})
        append_metrics(folder / f"seed_{seed}", 50, loss_rgb=0.5)
        append_metrics(folder / f"seed_{seed}", 100, loss=0.2, held_out_loss=0.1)
    return folder, model


def write(run, recording, frozen="one", compare=None):
    folder, model = run
    return write_report(
        folder, model, make_episodes()["eval"], [0, 1],
        task="balance_reaching", dataset=recording, policy="feedforward",
        origin={"task": "balance_reaching", "training": "decoupled"},
        settings={"world_model": {"seed": 3}}, command="python x.py", frozen=frozen, compare=compare,
    )  # fmt: skip


def test_the_result_collects_the_seeds(run, recording):
    compared = []
    result = write(run, recording, compare=lambda result: compared.append(result) or PUBLISHED)
    assert compared == [result]
    assert read_json(run[0] / "eval.json")["test_protocol"]["SR"] == result["test_protocol"]["SR"]
    assert result["row"] == "RGB+[P]" and result["trained_on"]["episodes"] == 4
    assert result["results"][1]["losses"] == {"step": [100], "held_out": [0.1], "training": [0.2]}
    both = [seed["test"]["summary"] for seed in result["results"]]
    for name in ("SR", "DR", "PE", "localization"):
        assert result["test_protocol"][name] == pytest.approx(np.mean([s[name] for s in both]), abs=1e-1), (
            name
        )
    assert result["test_protocol"]["episodes"] == 4
    rows = [unpack_rows(seed["test"]["rows"]) for seed in result["results"]]
    for name, outcome in (("SR", "success"), ("DR", "dropped")):
        assert result["test_protocol"][f"{name}_interval"] == shared_interval(rows, outcome)
    page = (run[0] / "report.html").read_text()
    assert "world_model.seed" in page and "89 (0.9)" in page and page.count("data:image/") == 3
    assert {path.name for path in (run[0] / "figures").iterdir()} == {"reconstruction.png", "dynamics.png"}


def test_seeds_on_different_world_models_are_no_row(run, recording):
    with pytest.raises(ValueError, match="another world model"):
        write(run, recording, frozen="two")


def make_result(paper=True):
    columns = {
        "first_scene_seed": 0,
        "success": "10",
        "dropped": "01",
        "touched": "00",
        "position_error": [0.01, 0.2],
    }
    rows = [{"success": True, "dropped": False, "position_error": 0.01}]
    return {
        "row": "Only-RGB", "policy": "recurrent", "task": "bin_dropping",
        "world_model": {"task": "balance_reaching", "training": "joint"},
        "test_protocol": summarize(rows), "results": [{"test": {"rows": columns}}],
    } | ({"paper_protocol": {"DR": (1.0, 2.0), "PE": (3.0, 4.0), "SR": (5.0, 6.0)}} if paper else {})  # fmt: skip


def test_text_shows_the_published_metrics_or_all():
    alone = row_text(make_result())
    assert "PE 3 (4.0) mm" in alone and "balance_reaching" in alone
    beside = row_text(make_result(), PUBLISHED)
    assert "SR 89 (0.9) %" in beside and "PE" not in beside
    assert len(row_text(make_result(paper=False)).splitlines()) == 2
