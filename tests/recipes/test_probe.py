"""The probe recipe on untrained world models."""

import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import run

from dynmap_rl.data import add_dynamics
from dynmap_rl.data.demonstrations import load_meta
from dynmap_rl.modules.checkpoints import make_world_model, save_world_model
from dynmap_rl.utils.files import read_json, write_json
from recipes.probe import load_world_models


@pytest.fixture(scope="module")
def trained(recording, tmp_path_factory):
    folder, constants = tmp_path_factory.mktemp("runs"), load_meta(recording)["normalization"]
    pose = {q: {end: values[:3] for end, values in constants[q].items()} for q in ("position", "velocity")}
    for name, supervision, ranges in (
        ("none", (), constants),
        ("position", ("position",), constants),
        ("pose", ("position", "velocity"), constants | pose),  # such as the commanded pose of the cart
    ):
        save_world_model(folder / name / "world_model", make_world_model(ranges, supervision))
        source = {"task": "balance_reaching", "training": "decoupled"}
        write_json(folder / name / "eval.json", {"world_model": source})
    six = {"low": [-1.0] * 6, "high": [1.0] * 6}
    save_world_model(folder / "robot" / "world_model", make_world_model(constants | {"action": six}, ()))
    write_json(folder / "robot" / "eval.json", {"world_model": {"training": "decoupled", "dataset": "robot"}})
    save_world_model(folder / "foreign" / "world_model", make_world_model(constants, ()))
    origin = {"training": "decoupled", "task": "absent:Task"}  # of a file, which must import nothing
    write_json(folder / "foreign" / "eval.json", {"world_model": origin})
    return folder


def test_writes_errors_and_probes_of_every_world_model(trained, recording, tmp_path):
    arguments = "--dataset", recording, "--context", "3", "--horizon", "4", "--train_episodes", "3"
    runs = ", ".join(str(trained / name) for name in ("none", "position", "pose"))
    result = run(tmp_path, "probe", "--runs", runs, *arguments)
    assert result.returncode == 0, result.stderr
    facts = read_json(tmp_path / "runs/probe/probe.json")
    assert (facts["train_episodes"], facts["test_episodes"]) == (3, 2)
    assert list(facts["open_loop"]) == ["RGB+[P], decoupled"]
    assert len(facts["open_loop"]["RGB+[P], decoupled"]["model"]["cart_mm"]) == 4
    names = ["Only-RGB, decoupled", "RGB+[P], decoupled", "RGB+[P+V], decoupled"]
    assert list(facts["probes"]) == list(facts["verdicts"]) == names
    assert len(facts["probes"]["Only-RGB, decoupled"]["latent"]["velocity"]) == 6
    for found in facts["perception"].values():
        assert list(found) == ["held-out demonstrations", "first ten steps"]
        for values in found.values():
            assert (
                values["chroma_explained"] < 0.5
                and values["object_error"] > 0.05
                and values["cart_error"] > 0
            )
    for name in ("open_loop", "probes", "perception"):
        assert (tmp_path / f"runs/probe/{name}.png").stat().st_size > 10_000
    page = (tmp_path / "runs/probe/report.html").read_text()
    assert page.count("data:image/png") == 3 and all(line in page for line in result.stdout.splitlines()[:-1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "nothing"], "nothing"),
        (["--runs", "robot"], "must be of a task, got robot"),
        (["--runs", "foreign"], "must be imported first; name it with --task"),
        (["--runs", "none", "--test_episodes", "0"], "test_episodes"),
        (["--runs", "position", "--horizon", "200"], "120, got 20 + 200"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(trained, recording, arguments, message):
    before = sorted(trained.rglob("*"))
    result = run(trained, "probe", "--dataset", recording, *arguments)
    assert result.returncode == 2
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert sorted(trained.rglob("*")) == before


def test_runs_of_one_row_are_named_by_their_folders(trained):
    source = read_json(trained / "none/eval.json")
    write_json(trained / "again/eval.json", source)
    shutil.copytree(trained / "none/world_model", trained / "again/world_model")
    none, again, position = (f"{trained / name}" for name in ("none", "again", "position"))
    models, task = load_world_models([none, again, f" {position}", f"{none}/"])
    row = "Only-RGB, decoupled"
    assert task == "balance_reaching"
    assert list(models) == [f"{row}, none", f"{row}, again", "RGB+[P], decoupled"]
    shutil.copytree(trained / "none", trained / "other" / "none")
    other = f"{trained / 'other' / 'none'}"
    assert list(load_world_models([none, other])[0]) == [f"{row}, {none}", f"{row}, {other}"]


def test_world_models_are_probed_on_their_own_task(trained, recordings, tmp_path):
    shutil.copytree(trained / "none", tmp_path / "bin")
    write_json(tmp_path / "bin/eval.json", {"world_model": {"task": "bin_dropping", "training": "decoupled"}})
    result = run(tmp_path, "probe", "--runs", f"bin,{trained / 'none'}")
    assert result.returncode == 2 and "one task, got bin of bin_dropping" in result.stderr
    few = "--train_episodes", "2", "--context", "3", "--horizon", "4"
    result = run(tmp_path, "probe", "--runs", "bin", "--dataset", recordings("bin_dropping"), *few)
    assert result.returncode == 0, result.stderr


def test_a_dataset_of_another_task_is_refused(trained, recordings, tmp_path):
    result = run(tmp_path, "probe", "--runs", trained / "none", "--dataset", recordings("bin_dropping"))
    assert result.returncode == 2 and "must be a dataset of balance_reaching" in result.stderr


def test_positions_of_other_things_are_no_truth(trained, recording, tmp_path):
    add_dynamics(recording, tmp_path / "centroid", source="centroid", replace=True)
    result = run(tmp_path, "probe", "--runs", trained / "none", "--dataset", "centroid")
    assert result.returncode == 2 and "6 entries, got 2" in result.stderr


def test_tracks_with_gaps_are_no_truth(trained, recording, tmp_path):
    add_dynamics(recording, tmp_path / "tracks", source="tracks", replace=True)
    for path in (tmp_path / "tracks/data").rglob("*.parquet"):
        table = pq.read_table(path)
        place = table.column_names.index("dynamics.found")
        nothing = pa.array([[False] * 6] * len(table), table.schema.field(place).type)
        pq.write_table(table.set_column(place, "dynamics.found", nothing), path)
    result = run(tmp_path, "probe", "--runs", trained / "none", "--dataset", "tracks")
    assert result.returncode == 2 and "must have the dynamics of every frame" in result.stderr
