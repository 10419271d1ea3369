"""The add_dynamics recipe on recordings of the tasks, which stay recordings."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from robot_dataset import read_column

from dynmap_rl.data import add_dynamics, record_dataset
from dynmap_rl.data.demonstrations import find_meta, load_dataset, load_demonstrations, load_meta
from dynmap_rl.paper.sources import source_columns
from recipes.add_dynamics import Config, main


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Pages are written to ``runs`` of the working folder."""
    monkeypatch.chdir(tmp_path)


def test_derived_dynamics_of_our_recordings_are_near_the_simulators(recording, tmp_path, capsys):
    """Positions are known, velocities within a tenth, accelerations, which jump every step, roughly."""
    settings = {"dataset": str(recording), "state": "dynamics.position", "angles": "2,5"}
    main(Config(**settings, output=tmp_path / "derived", replace=True))
    assert "velocity" in capsys.readouterr().out
    truth, derived = load_dataset(recording), load_dataset(tmp_path / "derived")
    assert set(truth.keys(True, True)) == set(derived.keys(True, True))
    for quantity, bound in (("position", 1e-6), ("velocity", 0.12), ("acceleration", 0.7)):
        a, b = truth["dynamics", quantity][..., :2], derived["dynamics", quantity][..., :2]
        assert (a - b).abs().mean() < bound * a.abs().mean(), quantity
    assert torch.equal(truth["pixels"], derived["pixels"])


def test_tracks_of_a_recording_are_in_its_units_and_it_stays_a_recording(recording, tmp_path):
    """Cart and block to some mm and degrees, and their velocities by tracks and by flow to a part of their size."""
    truth, velocities = load_dataset(recording)["dynamics"], {}
    for source in ("tracks", "flow"):
        main(Config(dataset=str(recording), output=tmp_path / source, source=source, replace=True))
        found = load_dataset(tmp_path / source)["dynamics"]
        error = (found["position"] - truth["position"]).abs().mean((0, 1))
        assert error[[0, 1, 3, 4]].max() < 0.01 and error[[2, 5]].max() < 0.1
        velocities[source] = found["velocity"]
        error = (found["velocity"] - truth["velocity"]).abs().mean()
        assert error < 0.7 * truth["velocity"].abs().mean()
    assert not torch.equal(*velocities.values())
    before, after = load_meta(recording), load_meta(tmp_path / "tracks")
    assert after["episodes"] == before["episodes"] and "layout" not in after
    assert after["normalization"]["action"] == before["normalization"]["action"]
    flow, quality = (
        json.loads((Path("runs/add_dynamics") / source / "quality.json").read_text())
        for source in ("flow", "tracks")
    )
    assert quality["checks"]["agreement"]["good"] and quality["command"]
    agreement = pytest.approx(quality["checks"]["agreement"]["value"])
    assert flow["checks"]["agreement"]["value"] == agreement, "the same two velocities"
    page = Path("runs/add_dynamics/tracks/report.html").read_text()
    assert f"derived columns: {quality['verdict']}" in page and page.count("data:image/") == 3


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"columns": "0,1,2", "angles": "2"}, ["cart_x", "cart_y", "cart_theta"]),
        ({"source": "centroid"}, ["x", "y"]),
    ],
)
def test_a_recording_with_fewer_entries_loads_with_constants_of_their_own(
    recording, tmp_path, settings, names
):
    main(Config(dataset=str(recording), output=tmp_path / "few", replace=True, **settings))
    episodes, constants = load_demonstrations(tmp_path / "few")
    assert episodes["train"]["dynamics", "velocity"].shape == (4, 120, len(names))
    assert len(constants["velocity"]["low"]) == len(names)
    assert load_meta(tmp_path / "few")["layout"]["position"] == names


def test_entries_that_are_no_bodies_end_a_recording(recording, tmp_path):
    main(Config(dataset=str(recording), output=tmp_path / "angle", replace=True, columns="2", angles="2"))
    assert find_meta(tmp_path / "angle") is None


def test_noise_is_seeded_and_has_the_given_size(recording, tmp_path):
    settings = {"dataset": str(recording), "state": "dynamics.position", "angles": "2,5", "replace": True}
    found = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        noise = {"noise": 0.005, "angle_noise": 0.02, "noise_seed": seed}
        main(Config(**settings, **noise, output=tmp_path / name))
        found.append(read_column(tmp_path / name, "dynamics.position"))
    assert np.array_equal(found[0], found[1]) and not np.array_equal(found[0], found[2])
    error = (found[0] - read_column(recording, "dynamics.position")).std(0)
    assert np.allclose(error, [0.005, 0.005, 0.02] * 2, rtol=0.15)


def test_trainings_of_the_tasks_leave_out_what_was_not_found(recording, tmp_path):
    add_dynamics(recording, tmp_path / "tracked", source="tracks", replace=True)
    for path in (tmp_path / "tracked/data").rglob("*.parquet"):
        table = pq.read_table(path)
        found = np.array(table["dynamics.found"].to_pylist())
        found[::7, 3:] = False
        place = table.column_names.index("dynamics.found")
        column = pa.FixedSizeListArray.from_arrays(pa.array(found.ravel()), 6)
        pq.write_table(table.set_column(place, "dynamics.found", column), path)
    found = read_column(tmp_path / "tracked", "dynamics.found")
    assert not found.all()
    episodes = load_dataset(tmp_path / "tracked")
    assert np.array_equal(episodes["labelled"].flatten(0, 1).numpy(), found)
    splits, _ = load_demonstrations(tmp_path / "tracked")
    labelled = torch.cat([splits[name]["labelled"] for name in ("train", "eval")])
    assert np.array_equal(labelled.flatten(0, 1).numpy(), found)


def test_tracks_are_cart_and_block_in_their_order_alone(recording, tmp_path):
    output = tmp_path / "tracked"
    add_dynamics(recording, output, source="tracks", sort="largest", replace=True)
    info = json.loads((output / "meta/info.json").read_text())
    assert info["features"]["dynamics.position"]["names"][0] == "object1_x"


def test_the_picture_of_a_recording_is_a_metre_wide(recording, tmp_path):
    with pytest.raises(ValueError, match="--width must be 1"):
        add_dynamics(recording, tmp_path / "tracked", source="tracks", replace=True, width=2.0)


def test_a_recording_of_a_task_that_is_not_imported_is_one_of_cart_and_block(recording, tmp_path):
    """A dataset must not run code, and its dynamics have the units and names of the tasks all the same."""
    own = shutil.copytree(recording, tmp_path / "own")
    path = own / "meta/dynmap.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"task": "my_tasks:Lift"}))
    for root, output in ((recording, "known"), (own, "unknown")):
        add_dynamics(root, tmp_path / output, source="tracks", replace=True)
    known, unknown = (read_column(tmp_path / name, "dynamics.position") for name in ("known", "unknown"))
    assert np.array_equal(known, unknown)
    assert "layout" not in json.loads((tmp_path / "unknown/meta/dynmap.json").read_text())
    add_dynamics(own, tmp_path / "angle", columns=np.array([2]), angles=np.array([2]), replace=True)
    assert find_meta(tmp_path / "angle") is None


def test_the_sources_of_task_3_can_be_derived(tmp_path):
    """Its block falls through more than a turn."""
    root = record_dataset(tmp_path / "bin", "bin_dropping", episodes=1, eval_episodes=1, workers=1)
    for source in ("central_0", "savgol_10"):
        add_dynamics(root, replace=True, preview=2, **source_columns("bin_dropping", source))
