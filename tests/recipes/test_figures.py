"""The figures recipe, on small datasets and on runs of untrained networks."""

import numpy as np
import pytest
from commands import run
from made_up import make_rows
from PIL import Image

from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.modules.checkpoints import make_policy, make_world_model, save_policy, save_world_model
from dynmap_rl.paper.cells import list_runs
from dynmap_rl.paper.figures import loss_panels
from dynmap_rl.utils.files import read_json, write_json
from recipes.paper.figures import FORMS, POLICIES, WORLD_MODEL, Config, main


def is_drawn(path) -> bool:
    """Whether a picture has more than a frame and its labels on white."""
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"))
    return len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100


def make_run(folder, constants, supervision, policy):
    """What a finished run holds, but untrained."""
    model = make_world_model(constants, supervision, latent_size=8, hidden_size=8)
    save_world_model(folder / "world_model", model)
    save_policy(folder / "seed_0" / "policy", make_policy(constants, policy, model, width=8), model)
    rows = make_rows(2, count=3) | {"dropped": "000", "touched": "000"}
    rows |= {"first_scene_seed": scene_seeds("test", 1)[0]}
    source = {"task": "balance_reaching", "training": "decoupled"}
    facts = {"task": "balance_reaching", "row": "RGB+[P]", "policy": policy, "world_model": source}
    losses = {"step": [100], "held_out": [0.1], "training": [0.2]}
    result = facts | {"seeds": [0], "results": [{"test": {"rows": rows}, "losses": losses}]}
    write_json(folder / "eval.json", result)
    write_json(folder.parent / f"{folder.name}.json", result)


@pytest.fixture(scope="module")
def runs(recording, tmp_path_factory):
    """A folder with the runs of Fig. 6, 8 and 9."""
    folder, constants = tmp_path_factory.mktemp("runs"), load_meta(recording)["normalization"]
    make_run(folder / WORLD_MODEL, constants, ("position", "velocity", "acceleration"), "recurrent")
    without, with_dynamics = (f"balance_reaching_decoupled_{name}" for name in POLICIES.values())
    make_run(folder / without, constants, (), "feedforward")
    make_run(folder / with_dynamics, constants, ("position", "velocity"), "recurrent")
    return folder


@pytest.fixture
def few_episodes(monkeypatch):
    """Four closed-loop episodes in the place of fifty."""
    monkeypatch.setattr(
        "dynmap_rl.envs.scene.scene_seeds", lambda split, count, start: scene_seeds(split, 4, start)
    )


@pytest.mark.slow
def test_draws_every_figure(runs, recordings, few_episodes, tmp_path, capsys):
    datasets = ",".join(str(recordings(task)) for task in ("balance_reaching", "bin_dropping"))
    main(Config(runs=runs, results=runs, output=tmp_path, datasets=datasets, architecture="glimpse"))
    names = {
        "distributions",
        "failures",
        *(f"fig{number}" for number in (2, 3, 4, 6, 7, 8, 9)),
    }
    assert {path.stem for path in tmp_path.glob("*.png")} == names
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png") == 9 and "Fig. 7: policy losses" in page and "drawn: fig2, " in page
    text = capsys.readouterr().out
    for name in names:
        assert is_drawn(tmp_path / f"{name}.png"), name
        assert f"written: {tmp_path}/{name}.png\n" in text


def test_draws_the_distributions_and_writes_their_ranges(recording, tmp_path):
    main(Config(only="distributions", datasets=str(recording), output=tmp_path / "figures"))
    assert (tmp_path / "figures/distributions.png").stat().st_size > 5000
    ranges = read_json(tmp_path / "figures/distributions.json")["ranges"]["balance_reaching"]
    angles = {f"{body} {name}" for body in ("cart", "block") for name in ("angle", "angular velocity")}
    assert set(ranges) == angles | {"tilt of the block on the cart"}
    for low, middle, high in ranges.values():
        assert 0 <= low <= middle < high
    assert ranges["block angle"][2] < 1, "demonstrations of task 1 carry the block upright"


def test_a_missing_dataset_is_named(tmp_path):
    with pytest.raises(ValueError, match="datasets/nothing"):
        main(Config(datasets="datasets/nothing", output=tmp_path / "figures"))
    assert not (tmp_path / "figures").exists()


def test_a_missing_run_is_named_after_the_other_figures(recording, tmp_path):
    given = "--only", "fig6,fig7,fig8,fig4", "--datasets", recording, "--results", "results"
    result = run(tmp_path, "figures", *given)
    assert result.returncode == 2
    assert result.stdout == "written: runs/figures/fig4.png\n"
    assert len(result.stderr.splitlines()) == 1
    assert f"fig6: runs/tables/{WORLD_MODEL} " in result.stderr
    command = "python recipes/paper/tables.py --results runs/results --only"
    assert f"{command} {WORLD_MODEL};" in result.stderr
    assert f"{command} balance_reaching_plain_none_feedforward (1 more: without --only)" in result.stderr
    folder = tmp_path / "runs/figures"
    assert sorted(path.name for path in folder.iterdir()) == ["fig4.png", "report.html"]
    assert f"fig6: runs/tables/{WORLD_MODEL}" in (folder / "report.html").read_text()


def test_a_dataset_that_a_figure_lacks_is_named(runs, recording, tmp_path):
    with pytest.raises(ValueError, match="fig9.*bin_dropping"):
        main(Config(runs=runs, output=tmp_path, only="fig9,fig4", datasets=str(recording)))
    assert is_drawn(tmp_path / "fig4.png")


def test_failures_of_the_runs_that_are_there_are_drawn(runs, tmp_path, capsys):
    main(Config(runs=runs, output=tmp_path, only="failures"))
    assert is_drawn(tmp_path / "failures.png") and "2 of 27 runs are there" in capsys.readouterr().out
    found = read_json(tmp_path / "failures.json")["failures"]
    assert [(one["policy"], one["episodes"]) for one in found] == [("recurrent", 3), ("feedforward", 3)]
    assert all(sum(map(len, one["scenes"].values())) == 1 for one in found)


@pytest.mark.slow
def test_what_is_there_is_drawn(runs, few_episodes, tmp_path, capsys):
    part = tmp_path / "runs"
    cell = f"balance_reaching_decoupled_{POLICIES['(b) RGB+[P+V], recurrent policy']}"
    part.mkdir()
    (part / cell).symlink_to(runs / cell)
    main(Config(runs=part, results=runs, output=tmp_path, only="fig7,fig8", architecture="glimpse"))
    assert is_drawn(tmp_path / "fig7.png") and is_drawn(tmp_path / "fig8.png")
    text = capsys.readouterr().out
    assert "3 of 25 results are there" in text and "1 of 2 runs are there" in text


def test_an_unknown_figure_gets_one_clear_line(tmp_path):
    result = run(tmp_path, "figures", "--only", "fig2,fig5")
    assert result.returncode == 2
    assert "fig5" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert not (tmp_path / "runs").exists()


def test_all_runs_are_cells_of_the_tables():
    cells = {run.name for run in list_runs()}
    names = {WORLD_MODEL}
    for form, word in FORMS.items():
        names |= {f"balance_reaching_{word}_{name}" for name in POLICIES.values()}
        for panel in loss_panels("balance_reaching", form).values():
            names |= {name for group in panel.values() for name in group}
    assert names <= cells
