"""Cheap measures of world models, and their rank correlation with success."""

import pytest
import torch
from small import CONSTANTS, make_episodes, make_model

from dynmap_rl.evaluation.statistics import welch_interval
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.paper import source_results
from dynmap_rl.paper.source_results import (
    find_unmeasured,
    gap_table,
    measure_world_model,
    measured_points,
    rank_correlations,
)
from dynmap_rl.utils.files import read_json, write_json


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(source_results, "CONTEXT", 4)
    monkeypatch.setattr(source_results, "HORIZON", 6)


def test_a_world_model_without_supervision_is_measured_like_any_other(short):
    episodes = make_episodes(2)["train"]
    torch.manual_seed(0)
    plain = make_world_model(CONSTANTS, (), latent_size=16, hidden_size=24)
    for model in (plain, make_model()):
        found = measure_world_model(model, episodes, episodes)
        assert set(found) == set(source_results.MEASURES)
        assert found["probe_position"] == pytest.approx(1, abs=1e-3), (
            "36 steps, fitted by more numbers than that"
        )


@torch.no_grad()
def linear_episodes(model, count):
    """Return episodes whose position at t is a linear map of what the model predicts for t from the frames before."""
    episodes = make_episodes(count)["train"].clone()
    states = torch.cat(
        model.predict(model.encode(episodes["pixels"], mixed=True).float(), episodes["action"]), -1
    )
    weights = torch.randn(states.shape[-1], 6, generator=torch.Generator().manual_seed(0))
    return episodes.set(("dynamics", "position"), 0.1 * states @ weights)


def test_the_map_reads_the_prediction_for_the_step_whose_position_it_gives(monkeypatch):
    monkeypatch.setattr(source_results, "CONTEXT", 8)
    monkeypatch.setattr(source_results, "HORIZON", 0)  # the position of step 7, from the frames up to step 6
    model = make_model()
    train, test = linear_episodes(model, 30), linear_episodes(model, 6)
    assert measure_world_model(model, train, test)["open_loop_mm"] < 0.1
    for shift in (-1, 1):
        moved = test.clone()
        moved["dynamics", "position"] = test["dynamics", "position"].roll(shift, 1)
        assert measure_world_model(model, train, moved)["open_loop_mm"] > 10


def test_the_open_loop_error_is_that_of_the_step_after_the_horizon(short):
    """It depends on the frames up to ``CONTEXT``, and on no position but the last."""
    model = make_model()
    train, test = linear_episodes(model, 30), linear_episodes(model, 6)
    error = measure_world_model(model, train, test)["open_loop_mm"]
    assert error > 1, "later frames are of use here"
    for step in (0, 3, 4, 8, 9, 10):
        other = test.clone()
        other["pixels"][:, step] = 255 - other["pixels"][:, step]
        changed = abs(measure_world_model(model, train, other)["open_loop_mm"] - error) > 1e-6
        assert changed == (step < 4), step
        other = test.clone()
        other["dynamics", "position"][:, step, [0, 3]] += 10
        changed = abs(measure_world_model(model, train, other)["open_loop_mm"] - error) > 1e-6
        assert changed == (step == 9), step


def write_result(path, successes):
    """Write a result with this many successes of five episodes."""
    flags = {"dropped": "00000", "touched": "00000", "first_scene_seed": 0, "position_error": [0.01] * 5}
    rows = flags | {"success": "1" * successes + "0" * (5 - successes)}
    write_json(path, {"results": [{"test": {"rows": rows}}], "command": "python x.py"})


def test_gaps_to_the_simulator_have_intervals_over_world_models(tmp_path):
    for source, counts in {"simulator": (5, 4), "tracks": (3, 4), "none": (1,)}.items():
        for seed, successes in enumerate(counts):
            write_result(tmp_path / f"balance_reaching_{source}_world_model_{seed}_recurrent.json", successes)
    low, high = welch_interval((60, 80), (100, 80))
    lines = gap_table(tmp_path, "balance_reaching").splitlines()[2:]
    assert lines == [
        "| none (Only-RGB) | -70.0 |  |",
        f"| frames: tracks | -20.0 [{low:+.1f}, {high:+.1f}] |  |",
    ]


def test_rank_correlations_are_over_the_sources(tmp_path):
    for count, source in enumerate(("none", "tracks", "flow", "command", "simulator")):
        name = f"balance_reaching_{source}_world_model_0_recurrent.json"
        write_result(tmp_path / name, count)
        measures = {
            "probe_position": count**2,
            "probe_velocity": 1.0 - count,
            "open_loop_mm": 10.0 / (1 + count),
        }
        write_json(tmp_path / "measures" / name, measures)
        if count == 3:
            assert rank_correlations(tmp_path, "balance_reaching") == {}, "four sources are too few"
    found = rank_correlations(tmp_path, "balance_reaching")
    rho = {name: row["rho"] for name, row in found.items()}
    assert rho == {
        ("recurrent", "probe_position"): pytest.approx(1),
        ("recurrent", "probe_velocity"): pytest.approx(-1),
        ("recurrent", "open_loop_mm"): pytest.approx(-1),
    }


def test_policies_on_another_training_of_a_world_model_are_not_paired_with_its_measures(tmp_path):
    name = "balance_reaching_tracks_world_model_0"
    for policy, model in (("recurrent", "a"), ("feedforward", "b")):
        path = tmp_path / f"{name}_{policy}.json"
        write_result(path, 3)
        write_json(path, read_json(path) | {"world_model_sha256": model})
    measures = dict.fromkeys(("probe_position", "probe_velocity", "open_loop_mm"), 0.5)
    for measured in (measures, measures | {"world_model_sha256": "a"}):
        write_json(tmp_path / "measures" / f"{name}_recurrent.json", measured)
        assert find_unmeasured(tmp_path) == [f"{name}_feedforward"]
        halves = {key: [0.5] for key in measures}
        assert measured_points(tmp_path, "balance_reaching", "recurrent") == (["tracks"], [60.0], halves)
        none = {key: [] for key in measures}
        assert measured_points(tmp_path, "balance_reaching", "feedforward") == ([], [], none)
    write_json(tmp_path / "measures" / f"{name}_recurrent.json", measures | {"world_model_sha256": "b"})
    assert find_unmeasured(tmp_path) == [f"{name}_recurrent"]
