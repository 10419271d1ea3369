"""Results of runs on robot datasets."""

import pytest
import torch
from small import make_episodes, make_model

from dynmap_rl.reporting import robot_page
from dynmap_rl.reporting.robot_page import robot_row_text, write_robot_report
from dynmap_rl.utils.files import read_json, write_json

NAMES = {"position": ["a", "b", "c", "d", "e", "f"], "action": ["x", "y", "z"]}


@pytest.fixture
def folder(tmp_path):
    for seed in (0, 1):
        held_out = {"error_rgb": 0.1 + 0.2 * seed, "imitation_l1": 0.5}
        held_out |= {f"error_position_{i}": float(i) for i in range(6)}
        held_out |= {f"error_action_{i}": 1.0 + seed for i in range(3)}
        result = {"held_out": held_out, "world_model_sha256": f"seed {seed}"}
        write_json(tmp_path / f"seed_{seed}/eval.json", result)
    return tmp_path


def write(folder, episodes, **options):
    origin = {"training": "joint", "dataset": "robot"}
    common = {"dataset": "robot", "camera": None, "goal": None, "policy": "recurrent", "origin": origin}
    settings = {"settings": {"dataset": "robot"}, "command": "python x.py"}
    return write_robot_report(folder, make_model().eval(), episodes, [0, 1], **common, **settings, **options)


def test_errors_are_means_over_seeds_beside_those_of_the_best_constant(folder, monkeypatch):
    described, drawn = {"names": NAMES, "info": {"fps": 10}, "cameras": ["top"]}, []
    monkeypatch.setattr(robot_page, "describe_robot_dataset", lambda *_: described)
    monkeypatch.setattr("dynmap_rl.reporting.figures.plot_reconstruction", lambda *_, dt: drawn.append(dt))
    episodes = make_episodes()["eval"].set("episode", torch.tensor([4, 4, 7])[:, None, None].expand(3, 12, 1))
    result = write(folder, episodes)
    assert result["held_out"]["rgb"] == pytest.approx(0.2)
    assert result["held_out"]["position"]["c"] == 2.0 and result["held_out"]["action"]["y"] == pytest.approx(
        1.5
    )
    values = episodes["action"].flatten(0, 1)[:, 1]
    assert result["spread"]["action"]["y"] == pytest.approx((values - values.median()).abs().mean().item())
    change = episodes["action"][..., 1].diff(dim=1).abs().mean().item()
    assert result["change"]["action"]["y"] == pytest.approx(change)
    assert result["trained_on"]["held_out_episodes"] == [4, 7] and "task" not in result
    assert read_json(folder / "eval.json")["held_out"] == result["held_out"] and drawn == [0.1]
    assert "0.2000" in robot_row_text(result) and "0.2000" in (folder / "report.html").read_text()
    episodes["disturbed"] = torch.zeros(3, 12, 1, dtype=torch.bool)
    episodes["disturbed"][:, 5:] = True
    undisturbed = episodes["action"][:, :5, 1].diff(dim=1).abs().mean().item()
    assert write(folder, episodes)["change"]["action"]["y"] == pytest.approx(undisturbed)
    with pytest.raises(ValueError, match="another world model"):
        write(folder, episodes, frozen="seed 0")


def test_an_entry_that_was_not_found_in_the_held_out_episodes_is_not_known(folder, monkeypatch):
    described = {"names": NAMES, "info": {"fps": 10}, "cameras": ["top"]}
    monkeypatch.setattr(robot_page, "describe_robot_dataset", lambda *_: described)
    monkeypatch.setattr("dynmap_rl.reporting.figures.plot_reconstruction", lambda *_, dt: None)
    path = folder / "seed_1/eval.json"
    result = read_json(path)
    result["held_out"]["error_position_2"] = float("nan")
    write_json(path, result)
    episodes = make_episodes()["eval"].set("episode", torch.tensor([4, 4, 7])[:, None, None].expand(3, 12, 1))
    assert "c not known" in robot_row_text(write(folder, episodes))
    assert read_json(folder / "eval.json")["held_out"]["position"]["c"] is None
