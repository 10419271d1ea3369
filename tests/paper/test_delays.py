"""Success against delay: conditions, table and figure."""

import matplotlib.pyplot as plt
import pytest
from small import CONSTANTS

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.paper import delays
from dynmap_rl.utils.files import write_json


def make_results(folder):
    for condition, rates in (("imagined", {0: 99.0, 10: 95.0}), ("stale", {0: 99.0, 10: 5.0, 30: 0.0})):
        cells = {
            str(d): {"SR": rate, "SR_interval": [rate - 1, rate + 1], "command": f"python {condition} {d}"}
            for d, rate in rates.items()
        }
        facts = {"task": "balance_reaching", "row": "RGB+[P]", "policy": "recurrent", "condition": condition}
        facts |= {"split": "test", "episodes": 50, "run": "runs/some", "trained": {"command": "python train"}}
        write_json(folder / f"{condition}.json", facts | {"cells": cells})
    return delays.read_delays(folder)


def test_the_table_has_a_line_for_each_condition_and_a_column_for_each_delay(tmp_path):
    lines = delays.delay_table(make_results(tmp_path)).splitlines()
    assert [cell.strip() for cell in lines[0].split("|")[6:-1]] == ["0 ms", "500 ms", "1500 ms"]
    stale, imagined = ([cell.strip() for cell in line.split("|")[6:-1]] for line in lines[2:])
    assert stale == ["**99.0** [98.0, 100.0]", "**5.0** [4.0, 6.0]", "**0.0** [-1.0, 1.0]"]
    assert imagined == ["**99.0** [98.0, 100.0]", "**95.0** [94.0, 96.0]", ""]
    page = delays.delay_page(make_results(tmp_path))
    assert "python imagined 0\npython imagined 10" in page and "50 scenes" in page
    assert "1. `runs/some`: `python train`" in page


def test_results_of_many_delays_are_lines_and_a_few_delays_are_dots(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    stale, imagined = make_results(tmp_path)
    long = imagined | {"row": "act", "policy": "LeRobot"}
    long["cells"] = {str(steps): stale["cells"]["10"] for steps in (0, 2, 4, 6, 8)}
    others = [result | {"row": "Only-RGB"} for result in (stale, imagined)]
    for plot in (delays.plot_delays, delays.plot_conditions):
        plot([stale, imagined, *others, long], tmp_path / "figure.png")
    [lines], [supervisions] = (figure.axes for figure in saved)
    assert read_lines(lines) == {
        "ACT: chunks from the present step": [[0, 5], [100, 5], [200, 5], [300, 5], [400, 5]]
    }
    found = read_lines(supervisions)
    markers = ["no delay", "stale frames, 500 ms", "stale frames, 1500 ms", "rolled forward, 500 ms"]
    assert [*found] == markers
    assert [rate for rate, _ in found["rolled forward, 500 ms"]] == [95, 95]
    names = [label.get_text() for label in supervisions.get_yticklabels()]
    assert names == ["RGB+[P], recurrent", "Only-RGB, recurrent"]
    plt.close("all")


def test_a_marker_of_one_supervision_is_left_out(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    stale, imagined = make_results(tmp_path)
    other = imagined | {"row": "Only-RGB"}
    delays.plot_conditions([stale, imagined, other], tmp_path / "figure.png")
    assert [*read_lines(saved[0].axes[0])] == ["no delay", "rolled forward, 500 ms"]
    plt.close("all")


def test_the_dots_of_a_line_are_of_one_run(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    stale, imagined = make_results(tmp_path)
    others = [result | {"row": "Only-RGB"} for result in (stale, imagined)]
    again = {steps: cell | {"SR": 1.0} for steps, cell in imagined["cells"].items()}
    delays.plot_conditions(
        [stale, imagined, *others, imagined | {"run": "x", "cells": again}], tmp_path / "f.png"
    )
    found = read_lines(saved[0].axes[0])
    assert [rate for rate, _ in found["rolled forward, 500 ms"]] == [95, 95]
    plt.close("all")


def test_policies_of_other_seeds_are_runs_of_their_own(tmp_path):
    stale, imagined = make_results(tmp_path)
    second = imagined | {"seed": 1}
    rows = [line.split("|")[4].strip() for line in delays.delay_table([stale, imagined, second]).splitlines()]
    assert rows[2:] == ["1", "1", "2"]
    assert "2. `runs/some, seed 1`" in delays.delay_page([stale, imagined, second])


@pytest.mark.parametrize(
    ("training", "architecture", "row"),
    [
        ("decoupled", "glimpse", "RGB+[P]"),
        ("joint", "glimpse", "RGB+[P], joint"),
        ("end_to_end", "plain", "End-to-End, plain"),
    ],
)
def test_rows_name_training_and_architecture(tmp_path, training, architecture, row):
    write_json(tmp_path / "eval.json", {"world_model": {"training": training}})
    world_model = make_world_model(CONSTANTS, ("position",), architecture=architecture)
    assert delays.name_row(tmp_path, world_model) == row


def test_conditions_of_a_run_share_a_panel(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    _, imagined = make_results(tmp_path)
    jitter, lost = (imagined | {"condition": name} for name in ("jitter", "lost_10"))
    delays.plot_conditions([imagined, jitter, lost], tmp_path / "figure.png")
    (panel,) = saved[0].axes
    assert read_lines(panel) == {"0 ms": [[99, -0.075], [99, 0.925]], "500 ms": [[95, 0.075], [95, 1.075]]}
    plt.close("all")


def test_all_of_many_delays_are_drawn(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    results = make_results(tmp_path)
    cells = dict.fromkeys(map(str, delays.DELAYS), results[0]["cells"]["0"])
    rows = [result | {"cells": cells, "row": row} for result in results for row in ("Only-RGB", "RGB+[P]")]
    delays.plot_conditions(rows, tmp_path / "figure.png")
    (panel,) = saved[0].axes
    assert len(read_lines(panel)) == 1 + 2 * (len(delays.DELAYS) - 1)
    plt.close("all")


def read_lines(axis):
    return {bars.get_label(): bars.lines[0].get_xydata().tolist() for bars in axis.containers}


@pytest.mark.parametrize("condition", delays.CONDITIONS)
def test_conditions_are_possible_at_long_delays(condition):
    assert all(delays.frame_delay(condition, steps).steps == steps for steps in (4, 30))


def test_what_is_impossible_is_left_out():
    assert delays.frame_delay("error_-3", 2) is None and delays.frame_delay("jitter", 0) is None
    assert delays.frame_delay("lost_30", 6) == FrameDelay(6, lost=0.3)
