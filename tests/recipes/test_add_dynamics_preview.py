"""The add_dynamics recipe with --preview: the verdict of the first episodes, and no dataset."""

import json

import pytest
from robot_dataset import make_robot_dataset

from dynmap_rl.data import add_dynamics
from recipes.add_dynamics import Config, main

LENGTHS = 31, 47, 24


@pytest.fixture(scope="module", params=[False, True], ids=["images", "videos"])
def dataset(tmp_path_factory, request):
    """Return the folder of a robot dataset of three episodes, and one of the first two of them."""
    folder = tmp_path_factory.mktemp("robot")
    make_robot_dataset(folder / "two", LENGTHS[:2], request.param)
    return make_robot_dataset(folder / "source", LENGTHS, request.param)


@pytest.mark.parametrize("source", ["state", "tracks", "state,tracks"])
def test_all_episodes_are_judged_as_in_the_dataset(dataset, tmp_path, source):
    settings = {"source": source, "columns": [0, 1]}
    whole = add_dynamics(dataset, tmp_path / "new", **settings)
    preview = add_dynamics(dataset, preview=len(LENGTHS), **settings)
    assert preview["quality"] == whole["quality"]


@pytest.mark.parametrize("source", ["state", "tracks"])
def test_the_first_episodes_are_judged_as_a_dataset_of_them(dataset, tmp_path, source):
    preview = add_dynamics(dataset, preview=2, source=source)
    two = add_dynamics(dataset.parent / "two", tmp_path / "new", source=source)
    assert preview["quality"] == two["quality"]


def test_only_a_page_is_written(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = sorted(dataset.parent.rglob("*"))
    main(Config(dataset=str(dataset), source="tracks", preview=1))
    assert sorted(dataset.parent.rglob("*")) == before
    folder = tmp_path / "runs/add_dynamics_preview/source"
    assert sorted(path.name for path in folder.iterdir()) == ["quality.json", "report.html", "tracks.png"]
    checks = json.loads((folder / "quality.json").read_text())["checks"].values()
    assert {check["episode"] for check in checks} == {0}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, "--output and --preview"),
        ({"output": "new", "preview": 1}, "--output and --preview"),
        ({"preview": 0}, "--preview .* 0"),
        ({"preview": 2, "source": "radar"}, "--source"),
    ],
)
def test_bad_input_is_refused(dataset, settings, message):
    with pytest.raises(ValueError, match=message):
        add_dynamics(dataset, **settings)
