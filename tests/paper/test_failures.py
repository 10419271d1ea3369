"""Failures of a run, found again; their table and figure."""

import matplotlib.pyplot as plt
import pytest
import torch
from made_up import make_rows, write

from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.evaluation.failures import CAUSES
from dynmap_rl.modules.checkpoints import make_policy, make_world_model, save_policy, save_world_model
from dynmap_rl.paper import failures
from dynmap_rl.paper.cells import TABLES, list_runs
from dynmap_rl.paper.failures import CELLS, REPEATED, find_failures, markdown_failures, plot_failures
from dynmap_rl.paper.results import read_cells
from dynmap_rl.utils.files import write_json

ONE = {
    "task": "balance_reaching",
    "row": "RGB+[P]",
    "policy": "recurrent",
    "training": "decoupled",
    "episodes": 50,
    "runs": ["a", "b"],
}
FAILURES = [
    ONE | {"scenes": {"stops short": [1, 2], "drops at the goal": [3]}},
    ONE | {"row": "Only-RGB", "scenes": {REPEATED: [4]}},
    ONE | {"task": "bin_dropping", "scenes": {}},
]


def test_the_runs_are_those_of_the_grid():
    assert {name for names in CELLS for name in names} <= {run.name for run in list_runs()}


def test_failed_episodes_alone_are_run_again(recording, tmp_path):
    from small import CONSTANTS

    torch.manual_seed(0)
    model = make_world_model(CONSTANTS, ("position",), latent_size=8, hidden_size=8)
    save_world_model(tmp_path / "world_model", model)
    save_policy(tmp_path / "seed_1/policy", make_policy(CONSTANTS, "feedforward", model, width=8), model)
    first = scene_seeds("test", 1)[0]
    rows = make_rows(1, count=3) | {"dropped": "000", "touched": "000", "first_scene_seed": first}
    facts = {"task": "balance_reaching", "row": "RGB+[P]", "policy": "feedforward", "seeds": [1]}
    source = {"task": "balance_reaching", "training": "decoupled"}
    write_json(tmp_path / "eval.json", facts | {"world_model": source, "results": [{"test": {"rows": rows}}]})
    found = find_failures([tmp_path])
    assert found["episodes"] == 3 and found["training"] == "decoupled"
    assert found["runs"] == [tmp_path.name]
    assert sorted(seed for seeds in found["scenes"].values() for seed in seeds) == [first + 1, first + 2]
    assert set(found["scenes"]) <= {*CAUSES, REPEATED}
    twice = find_failures([tmp_path, tmp_path])
    assert twice["episodes"] == 6 and all(
        len(twice["scenes"][c]) == 2 * len(s) for c, s in found["scenes"].items()
    )


def test_a_row_has_the_shares_of_its_causes():
    lines = markdown_failures(FAILURES, {}).splitlines()
    assert (
        lines[0] == "| % of the episodes | fail | drops at the goal | stops short | succeeds when repeated |"
    )
    assert (
        lines[2]
        == "| balance_reaching: RGB+[P], decoupled, recurrent, 2 world models, first policy | 6.0 | 2.0 | 4.0 |  |"
    )
    assert lines[3].endswith("| 2.0 |  |  | 2.0 |") and lines[4].endswith("| 0.0 |  |  |  |")


def test_results_that_name_causes_have_a_row(tmp_path):
    write(tmp_path, "RGB+[V]", 30, 20, causes={"stops short": [30, 31], "overshoots": [39]})
    write(tmp_path, "RGB+[P]", 20, 20)
    lines = markdown_failures(FAILURES[2:], read_cells(tmp_path, TABLES)).splitlines()
    assert lines[0] == "| % of the episodes | fail | stops short | overshoots |"
    assert lines[3:] == [
        "| balance_reaching: RGB+[V], decoupled, recurrent, 2 world models, all policies | 7.5 | 5.0 | 2.5 |"
    ]


@pytest.mark.parametrize("given", [FAILURES, FAILURES[2:]])
def test_bars_are_the_shares(tmp_path, monkeypatch, given):
    saved = []
    monkeypatch.setattr(failures, "save_figure", lambda figure, path: saved.append(figure))
    plot_failures(given, tmp_path / "failures.png")
    [axis] = saved[0].axes
    ends = [max([bar.get_x() + bar.get_width() for bar in axis.patches if round(bar.get_y() + 0.4) == row] or [0])
            for row in range(len(given))]  # fmt: skip
    assert ends == ([6.0, 2.0, 0.0] if len(given) == 3 else [0])
    plt.close("all")
