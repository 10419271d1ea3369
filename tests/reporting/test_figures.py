"""Figures of world models; tests/recipes/test_figures.py draws those of the paper."""

import subprocess
import sys

from small import make_episodes, make_model

from dynmap_rl.reporting.figures import plot_dynamics


def test_importing_leaves_the_backend_of_a_notebook():
    code = (
        "import matplotlib; matplotlib.use('svg'); import dynmap_rl.reporting.figures; "
        "assert matplotlib.get_backend() == 'svg'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_dynamics_of_other_entries_are_not_drawn(tmp_path):
    """A world model of the cart's commanded pose knows three of the six entries of a recording."""
    model, episode = make_model(), make_episodes()["eval"][0]
    plot_dynamics(model, episode, tmp_path / "own.png")
    assert (tmp_path / "own.png").exists()
    others = episode.copy()
    others["dynamics", "position"] = episode["dynamics", "position"][..., :3]
    plot_dynamics(model, others, tmp_path / "others.png")
    assert not (tmp_path / "others.png").exists()
