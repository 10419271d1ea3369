"""Success against delay: conditions, table and figure."""

import matplotlib.pyplot as plt
import pytest

from dynmap_rl.envs.delay import FrameDelay
from dynmap_rl.paper import delays
from dynmap_rl.utils.files import write_json


def make_results(folder):
    for condition, rates in (("imagined", {0: 99.0, 10: 95.0}), ("stale", {0: 99.0, 10: 5.0, 30: 0.0})):
        cells = {str(d): {"SR": rate, "SR_interval": [rate - 1, rate + 1]} for d, rate in rates.items()}
        facts = {"task": "balance_reaching", "row": "RGB+[P]", "policy": "recurrent", "condition": condition}
        facts |= {"split": "test", "episodes": 50, "command": f"python {condition}"}
        write_json(folder / f"{condition}.json", facts | {"cells": cells})
    return delays.read_delays(folder)


def test_the_table_has_a_line_for_each_condition_and_a_column_for_each_delay(tmp_path):
    lines = delays.delay_table(make_results(tmp_path)).splitlines()
    assert [cell.strip() for cell in lines[0].split("|")[5:-1]] == ["0 ms", "500 ms", "1500 ms"]
    stale, imagined = ([cell.strip() for cell in line.split("|")[5:-1]] for line in lines[2:])
    assert stale == ["**99.0** [98.0, 100.0]", "**5.0** [4.0, 6.0]", "**0.0** [-1.0, 1.0]"]
    assert imagined == ["**99.0** [98.0, 100.0]", "**95.0** [94.0, 96.0]", ""]
    page = delays.delay_page(make_results(tmp_path))
    assert "python imagined" in page and "50 scenes" in page


def test_the_figure_has_a_line_for_each_condition(tmp_path, monkeypatch):
    saved = []
    monkeypatch.setattr(delays, "save_figure", lambda figure, path: saved.append(figure))
    delays.plot_delays(make_results(tmp_path), tmp_path / "figure.png")
    [axis] = saved[0].axes
    lines = {line.get_label(): line.get_xydata().tolist() for line in axis.get_lines()}
    assert lines == {
        "stale frames": [[0, 99], [500, 5], [1500, 0]],
        "rolled forward": [[0, 99], [500, 95]],
    }
    plt.close("all")


@pytest.mark.parametrize("condition", delays.CONDITIONS)
def test_conditions_are_possible_at_long_delays(condition):
    assert all(delays.frame_delay(condition, steps).steps == steps for steps in (4, 30))


def test_what_is_impossible_is_left_out():
    assert delays.frame_delay("error_-3", 2) is None and delays.frame_delay("jitter", 0) is None
    assert delays.frame_delay("lost_30", 6) == FrameDelay(6, lost=0.3)
