"""What the figures of the paper show."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.paper import figures as paper_figures
from dynmap_rl.paper.cells import list_runs
from dynmap_rl.paper.figures import (
    draw_position_errors,
    loss_panels,
    plot_losses,
    plot_position_errors,
    read_losses,
    widest_ways,
)
from dynmap_rl.reporting.figures import moving_steps

RED, BLUE = to_hex("tab:red"), to_hex("tab:blue")


@pytest.fixture
def figures(monkeypatch):
    """The figures that would have been saved."""
    saved = []
    monkeypatch.setattr(paper_figures, "save_figure", lambda figure, path: saved.append(figure))
    yield saved
    plt.close("all")


def make_result(*seeds: list[float], every=100) -> dict:
    """A result with the held-out losses of some seeds; those in training are twice as large."""
    losses = [
        {
            "step": [every * i for i in range(1, len(values) + 1)],
            "held_out": values,
            "training": [2 * v for v in values],
        }
        for values in seeds
    ]
    return {"results": [{"losses": one} for one in losses]}


def closed_loop(drops: list[int | None], steps=12) -> TensorDict:
    """Episodes that stand still 0.1, 0.2, ... m from the goal, with the steps in which the block is dropped."""
    position, goal = torch.zeros(len(drops), steps, 6), torch.zeros(len(drops), steps, 2)
    dropped = torch.zeros(len(drops), steps, 1, dtype=torch.bool)
    for i, t in enumerate(drops):
        goal[i, :, 0] = 0.1 * (i + 1)
        dropped[i, steps if t is None else t :] = True
    entries = {"dynamics": {"position": position}, "goal": goal, "next": {"dropped": dropped}}
    return TensorDict(entries, [len(drops), steps])


def test_losses_are_those_of_every_seed():
    results = [make_result([0.5, 0.25], [0.4, 0.2]), make_result([0.3, 0.1])]
    steps, losses = read_losses(results)
    assert steps.tolist() == [100, 200]
    assert losses.tolist() == [[0.5, 0.25], [0.4, 0.2], [0.3, 0.1]]


def test_only_steps_that_all_seeds_have_are_compared():
    steps, losses = read_losses([make_result([0.5, 0.4, 0.3], [0.2, 0.1])])
    assert steps.tolist() == [100, 200] and losses.tolist() == [[0.5, 0.4], [0.2, 0.1]]
    assert [len(values) for values in read_losses([{"results": [{}]}])] == [0, 0]


def test_curves_are_means_over_the_seeds_of_a_group(tmp_path, figures):
    panels = loss_panels("balance_reaching")
    with_velocity = panels["(e) velocity prediction"]["with velocity"]
    results = {
        with_velocity[0]: make_result([0.5, 0.25], [0.3, 0.15]),
        with_velocity[1]: make_result([0.1, 0.05]),
    }
    plot_losses(panels, results, tmp_path / "fig7.png")
    axes = {axis.get_title(): axis for axis in figures[0].axes}
    assert list(axes) == list(panels)
    there, absent = axes["(e) velocity prediction"].lines
    assert there.get_xdata().tolist() == [100, 200]
    np.testing.assert_allclose(there.get_ydata(), [0.3, 0.15])
    assert there.get_label() == "with velocity (2 of 4 runs)"
    assert absent.get_label() == "without velocity: not run" and not len(absent.get_xdata())


def test_panels_compare_one_thing_each():
    panels = loss_panels("balance_reaching")
    assert [len(groups) for groups in panels.values()] == [8, 3, 2, 2, 2, 2]
    for quantity, letter in zip(("position", "velocity", "acceleration"), "def", strict=True):
        have, lack = panels[f"({letter}) {quantity} prediction"].values()
        assert len(have) == len(lack) == 4
        assert all(quantity in name for name in have) and not any(quantity in name for name in lack)
    plain = loss_panels("balance_reaching", "plain")
    assert list(plain["(b) training approach"]) == ["decoupled", "end-to-end"]
    names = {name for groups in plain.values() for group in groups.values() for name in group}
    assert len(names) == 17 and all("_plain_" in name for name in names)
    assert names < {run.name for run in list_runs()}, "all can be run"


def test_a_panel_of_nothing_says_that_it_was_not_run(tmp_path, figures):
    panels = loss_panels("balance_reaching")
    results = {"balance_reaching_joint_none_recurrent": make_result([0.5])}
    plot_losses(panels, results, tmp_path / "fig7.png")
    plot_position_errors({"one": closed_loop([None]), "two": None}, tmp_path / "fig8.png")
    said = [[text.get_text() for text in axis.texts] for figure in figures for axis in figure.axes]
    assert said == [["not run"], [], *([["not run"]] * 4), [], ["not run"]]


def test_dropped_episodes_are_red():
    axis = plt.figure().subplots()
    draw_position_errors(axis, closed_loop([None, 4, None, 11]))
    lines = {round(line.get_ydata()[0]): line for line in axis.lines if len(line.get_xdata()) == 12}
    colors = {error: to_hex(line.get_color()) for error, line in lines.items()}
    assert colors == {100: BLUE, 200: RED, 300: BLUE, 400: RED}  # error in mm
    dots = sorted(tuple(line.get_xydata()[0].round(2)) for line in axis.lines if line.get_marker() == "o")
    assert dots == [(0.25, 200), (0.55, 400)]  # where the next state is a drop
    labels = [text.get_text() for text in axis.get_legend().get_texts()]
    assert labels == ["block stays (2)", "block dropped (2)", "success: under 50 mm"]
    plt.close("all")


def test_demonstrations_are_shown_while_the_block_moves(recording):
    episodes = load_dataset(recording, "train")
    chosen = widest_ways(episodes, 2)
    assert chosen.shape == (2, 120)
    pushed = episodes["disturbed"].flatten(1).any(1)
    assert bool(chosen["disturbed"][0].any()) == bool(pushed.all()), "one without pushes comes first"
    steps = moving_steps(chosen[0], 8, first=1)
    assert steps[0] == 1 and steps == sorted(set(steps)) and len(steps) == 8
    speed = chosen[0]["dynamics", "velocity"][:, 3:5].norm(dim=-1)
    assert speed[steps[-1]] > 0.02 and (speed[steps[-1] + 1 :] <= 0.02).all()
    still = chosen[0].clone()
    still["dynamics", "velocity"].zero_()
    assert moving_steps(still, 4) == [0, 1, 2, 3]
