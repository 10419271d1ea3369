"""Bad input of the add_dynamics recipe: one error, and nothing is written."""

import shutil

import pytest
from robot_dataset import make_robot_dataset

from recipes.add_dynamics import Config, main


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Return the folder of a robot dataset."""
    return make_robot_dataset(tmp_path_factory.mktemp("images") / "source")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"state": "observation.nothing"}, "observation.nothing"),
        ({"columns": "0,4"}, "--columns"),
        ({"columns": "a"}, "--columns.*'a'"),
        ({"columns": "0,1", "angles": "2"}, "--angles"),
        ({"method": "spline"}, "--method"),
        ({"method": "savgol", "window": 4}, "--window"),
        ({"method": "savgol", "window": 25}, "24"),
        ({"source": "centroid", "camera": "front"}, "--camera .*observation.images.top.*'front'"),
        ({"dataset": "no/where/here"}, "no/where/here"),
        ({"dataset": None}, "--dataset"),
        ({"source": "tracks", "columns": "0"}, "--columns has no effect with --source tracks"),
        ({"camera": "observation.images.top"}, "--camera has no effect with --source state"),
        ({"source": "radar"}, "--source .*'radar'"),
        ({"source": "tracks", "objects": 0}, "--objects"),
        ({"source": "centroid", "objects": 2}, "--objects has no effect with --source centroid"),
        ({"source": "tracks", "colors": ""}, "--colors"),
        ({"source": "centroid", "sort": "largest"}, "--sort has no effect with --source centroid"),
        ({"source": "tracks", "colors": "red,#ff0000"}, "--colors must be a different colour"),
        ({"source": "tracks", "colors": "#c81e1e00"}, "--colors"),
        ({"source": "tracks", "noise_seed": 1}, "--noise_seed has no effect"),
        ({"source": "tracks", "threshold": 0}, "--threshold"),
        ({"source": "tracks", "colors": "redd"}, "--colors .*'redd'"),
        ({"source": "tracks", "colors": "lime"}, "#00ff00"),
        ({"source": "tracks", "colors": "red", "objects": 1}, "--objects .* no effect with --colors"),
        ({"colors": "red"}, "--colors has no effect with --source state"),
        ({"source": "state,tracks", "columns": "0,4"}, "--columns"),
        ({"source": "tracks", "sort": "oldest"}, "--sort .*'oldest'"),
        ({"source": "tracks", "noise": 0.1}, "--noise has no effect"),
        ({"source": "tracks", "width": -1.0}, "--width"),
        ({"source": "tracks", "width": float("inf")}, "--width"),
        ({"source": "tracks", "objects": 300}, "--objects"),
        ({"noise": -1.0}, "--noise"),
        ({"noise_seed": 1}, "--noise_seed has no effect"),
        ({"noise": float("nan")}, "--noise"),
        ({"angles": "2", "period": 0.0}, "--period must be above 0"),
        ({"angles": "2", "period": 1.0}, "--period 360 for degrees"),
        ({"window": 21}, "--window has no effect with --method central"),
        (
            {"source": "tracks", "method": "central", "order": 4},
            "--order has no effect with --method central",
        ),
        ({"period": 360.0}, "--period has no effect with a state without --angles"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(dataset, tmp_path, settings, message):
    with pytest.raises(ValueError, match=message):
        main(Config(**({"dataset": str(dataset), "output": tmp_path / "bad"} | settings)))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["stats.json", "episodes/chunk-000/file-000.parquet"])
def test_a_damaged_file_is_named_and_nothing_is_left(dataset, tmp_path, name):
    shutil.copytree(dataset, tmp_path / "damaged")
    path = tmp_path / "damaged/meta" / name
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(ValueError, match=name):
        main(Config(dataset=str(tmp_path / "damaged"), output=tmp_path / "new"))
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]
