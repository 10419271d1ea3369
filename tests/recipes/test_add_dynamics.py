"""The add_dynamics recipe: the columns, their statistics, and a new folder that is complete or absent."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import robot_dataset
import torch
from commands import run
from robot_dataset import CAMERA, FPS, make_robot_dataset, read_column

from dynmap_rl.data import add_dynamics, load_robot_dataset
from recipes.add_dynamics import Config, main

RECIPE = Path(__file__).parents[2] / "recipes" / "add_dynamics.py"
QUANTITIES = ("position", "velocity", "acceleration")
LENGTHS = (31, 47, 24, 33)


def make_pair(folder, videos):
    source, output = make_robot_dataset(folder / "source", LENGTHS, videos), folder / "output"
    main(Config(dataset=str(source), output=output, columns="0,1,2", angles="2"))
    return source, output


@pytest.fixture(scope="module", autouse=True)
def folder_of_runs(tmp_path_factory):
    """Return the folder of the recipe's pages."""
    with contextlib.chdir(tmp_path_factory.mktemp("runs")):
        yield Path.cwd() / "runs/add_dynamics"


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    return make_pair(tmp_path_factory.mktemp("images"), videos=False)


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    return make_pair(tmp_path_factory.mktemp("videos"), videos=True)


@pytest.fixture(params=["images", "videos"])
def pair(request):
    """Return a robot dataset, and its copy with dynamics of x, y and the angle."""
    return request.getfixturevalue(request.param)


def open_with_lerobot(root):
    from dynmap_rl.data.format.quiet import quiet

    with quiet():
        from lerobot.datasets import LeRobotDataset

        return LeRobotDataset("test/robot", root=root, video_backend="pyav")


def test_lerobot_reads_it_and_nothing_else_has_changed(pair):
    before, after = map(open_with_lerobot, pair)
    assert len(after) == len(before) == sum(LENGTHS)
    new = {f"dynamics.{q}" for q in QUANTITIES}
    assert after.meta.features.keys() - before.meta.features.keys() == new
    assert after.meta.features["dynamics.velocity"]["names"] == ["x", "y", "angle"]
    for i in (0, 30, 31, 134):
        old, item = before[i], after[i]
        assert item.keys() - old.keys() == new
        assert item["dynamics.velocity"].shape == (3,)
        assert all(
            torch.equal(item[k], old[k]) if torch.is_tensor(old[k]) else item[k] == old[k] for k in old
        )


def test_a_page_shows_the_new_columns(folder_of_runs, videos):
    page = (folder_of_runs / "output/report.html").read_text()
    assert f"{sum(LENGTHS)} frames" in page and "dynamics.acceleration angle" in page
    assert page.count("data:image/") == 2, "frames of the videos, and the columns over time"


def test_the_hub_reads_the_tables(pair):
    import datasets

    [path] = (pair[1] / "data").rglob("*.parquet")
    assert "dynamics.acceleration" in datasets.Features.from_arrow_schema(pq.read_schema(path))
    described = json.loads(pq.read_schema(path).metadata[b"huggingface"])["info"]["features"]
    assert list(described) == pq.read_schema(path).names
    assert pq.ParquetFile(path).num_row_groups == len(LENGTHS)


def test_files_of_frames_are_the_same(pair):
    source, output = pair
    videos = list((source / "videos").rglob("*.mp4"))
    for path in videos:
        assert (output / path.relative_to(source)).read_bytes() == path.read_bytes()
    if not videos:
        [a], [b] = (list((root / "data").rglob("*.parquet")) for root in pair)
        assert pq.read_table(a)[CAMERA].equals(pq.read_table(b)[CAMERA])


def test_angles_are_unwrapped_and_episodes_do_not_mix(pair):
    state = read_column(pair[0], "observation.state")
    position, velocity, acceleration = (read_column(pair[1], f"dynamics.{q}") for q in QUANTITIES)
    assert np.abs(np.diff(state[:, 2])).max() > 6, "the angle jumps"
    borders = np.cumsum([0, *LENGTHS])
    for start, end in pairwise(borders):
        # Every square glides and turns at a speed of its own, to its first and its last step.
        own = velocity[start:end]
        assert np.abs(own - own.mean(0)).max() < 1e-4
        rate = (position[end - 1] - position[start]) * FPS / (end - 1 - start)
        assert np.abs(own.mean(0) - rate).max() < 1e-4
        assert np.abs(np.diff(position[start:end, 2])).max() < 0.2
    assert np.abs(acceleration).max() < 5e-3  # of states that are float32
    assert np.abs(position[:, :2] - state[:, :2]).max() == 0


def test_statistics_are_those_of_the_columns(pair):
    root = pair[1]
    stats = json.loads((root / "meta/stats.json").read_text())
    [episodes] = (root / "meta/episodes").rglob("*.parquet")
    rows = pq.read_table(episodes).to_pylist()
    borders = np.cumsum([0, *LENGTHS])
    for quantity in QUANTITIES:
        values = read_column(root, f"dynamics.{quantity}")
        check(stats[f"dynamics.{quantity}"], values)
        for i, row in enumerate(rows):
            prefix = f"stats/dynamics.{quantity}/"
            own = {key.removeprefix(prefix): value for key, value in row.items() if key.startswith(prefix)}
            check(own, values[borders[i] : borders[i + 1]])
    assert rows[0].keys() >= {"stats/action/mean", "tasks", "length"}
    old = json.loads((pair[0] / "meta/stats.json").read_text())
    assert stats["action"] == old["action"]
    assert stats.keys() == {*old, *(f"dynamics.{quantity}" for quantity in QUANTITIES)}


def check(stats, values):
    assert stats["count"] == [len(values)]
    for name, function in (("mean", np.mean), ("std", np.std), ("min", np.min), ("max", np.max)):
        assert np.allclose(stats[name], function(values, axis=0), atol=1e-6), name
    spread = np.ptp(values, axis=0)
    for name in ("q01", "q50", "q99"):
        error = np.abs(stats[name] - np.quantile(values, int(name[1:]) / 100, axis=0))
        assert (error <= 0.2 * spread + 1e-6).all(), name  # LeRobot's are those of a histogram


def test_positions_from_the_frames(videos, tmp_path):
    main(Config(dataset=str(videos[0]), output=tmp_path / "tracked", source="centroid"))
    position, state = (
        read_column(tmp_path / "tracked", "dynamics.position"),
        read_column(videos[0], "observation.state"),
    )
    assert open_with_lerobot(tmp_path / "tracked").meta.features["dynamics.position"]["names"] == ["x", "y"]
    error = np.abs(position - (state[:, :2] * [128, 96] - 0.5))
    assert np.median(error) < 1.5 and error.mean() < 4, "pixels; the place that is background is not found"


def test_one_entry_is_a_column_of_numbers(images, tmp_path):
    main(Config(dataset=str(images[0]), output=tmp_path / "one", columns="1", method="savgol", window=5))
    assert open_with_lerobot(tmp_path / "one")[40]["dynamics.velocity"].numel() == 1


@pytest.mark.slow
def test_a_killed_run_leaves_nothing_that_looks_done(images, tmp_path):
    output = tmp_path / "output"
    arguments = "--dataset", str(images[0]), "--output", str(output)
    kill = "import os; from dynmap_rl.data.format import columns; columns.compute_stats = lambda *a: os._exit(9);"
    code = f"{kill} import runpy, sys; sys.argv[1:] = {list(arguments)}; runpy.run_path({str(RECIPE)!r}, run_name='__main__')"
    killed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=os.environ)
    assert killed.returncode == 9, killed.stderr
    assert [path.name for path in tmp_path.iterdir()] == [".output.add_dynamics"]
    main(Config(dataset=str(images[0]), output=output))
    assert [path.name for path in tmp_path.iterdir()] == ["output"]


def test_state_and_tracks_stand_side_by_side_and_are_judged_together(videos, tmp_path):
    output = tmp_path / "both"
    options = "--source", "state,tracks", "--columns", "0,1", "--colors", "#c81e1e", "--point"
    done = run(tmp_path, "add_dynamics", "--dataset", videos[0], "--output", output, *options)
    assert done.returncode == 0, done.stderr
    features = json.loads((output / "meta/info.json").read_text())["features"]
    assert features["dynamics.velocity"]["names"] == ["x", "y", "object1_x", "object1_y"]
    position, velocity = read_column(output, "dynamics.position"), read_column(output, "dynamics.velocity")
    pixels = np.array([128, 96])
    assert np.abs(position[:, 2:] - pixels * position[:, :2]).max() < 2
    assert np.corrcoef(velocity[:, 2], velocity[:, 0])[0, 1] > 0.95  # squares are drawn at whole pixels
    how = json.loads((output / "meta/dynamics.json").read_text())
    assert how["methods"] == ["central", "savgol"] and how["state"]["columns"] == [0, 1]
    assert how["frames"]["point"] and how["frames"]["colors"] == [[200, 30, 30]]
    checks = json.loads((tmp_path / "runs/add_dynamics/both/quality.json").read_text())["checks"]
    assert {"lost", "residual", "agreement"} < set(checks) and "residual_angle" not in checks
    assert (tmp_path / "runs/add_dynamics/both/tracks.png").exists()


def test_entries_of_an_object_that_is_hidden_are_not_labels(monkeypatch, tmp_path):
    drawn, draw = [], robot_dataset.draw
    table = np.full((96, 128, 3), 190, np.uint8)
    monkeypatch.setattr(
        robot_dataset, "draw", lambda p: drawn.append(p) or (table if 10 < len(drawn) < 15 else draw(p))
    )
    source = make_robot_dataset(tmp_path / "source", LENGTHS)
    colored = {"colors": ["#c81e1e"], "point": True, "columns": [0, 1]}
    add_dynamics(source, tmp_path / "both", source="state,tracks", **colored)
    info = json.loads((tmp_path / "both/meta/info.json").read_text())["features"]["dynamics.found"]
    assert info["dtype"] == "bool" and info["names"] == ["x", "y", "object1_x", "object1_y"]
    hidden = np.zeros((sum(LENGTHS), 4), dtype=bool)
    hidden[10:14, 2:] = True
    assert np.array_equal(read_column(tmp_path / "both", "dynamics.found").astype(bool), ~hidden)
    episodes, _ = load_robot_dataset(tmp_path / "both", min_steps=24, image_size=32)
    pieces = torch.cat(list(episodes.values()))
    assert pieces["labelled"].dtype == torch.bool and 0 < (~pieces["labelled"]).sum() <= 2 * 8
    assert open_with_lerobot(tmp_path / "both")[12]["dynamics.found"].tolist() == [True, True, False, False]
    add_dynamics(tmp_path / "both", tmp_path / "again", columns=[0, 1], replace=True)
    assert read_column(tmp_path / "again", "dynamics.found").all(), "nothing is left of the tracks"


def test_files_beside_the_output_stay(images, tmp_path):
    other = tmp_path / "output.tmp"
    other.mkdir()
    (other / "thesis.tex").touch()
    main(Config(dataset=str(images[0]), output=tmp_path / "output"))
    assert (other / "thesis.tex").exists()


def test_a_copy_holds_what_links_lead_to_and_no_notes_of_file_managers(videos, tmp_path):
    root = tmp_path / "linked"
    shutil.copytree(videos[0], root)
    for name in ("videos", "data"):
        shutil.move(root / name, tmp_path / name)
        (root / name).symlink_to(tmp_path / name)
    (tmp_path / "data/chunk-000/.DS_Store").write_bytes(b"x")
    (tmp_path / "data/chunk-000/notes.txt").write_text("mine")
    add_dynamics(root, tmp_path / "output", columns=[0, 1])
    files = {str(path.relative_to(videos[1])) for path in videos[1].rglob("*") if path.is_file()}
    copied = {
        str(path.relative_to(tmp_path / "output"))
        for path in (tmp_path / "output").rglob("*")
        if path.is_file()
    }
    assert copied == files | {"data/chunk-000/notes.txt"}
    assert not any(path.is_symlink() for path in (tmp_path / "output").rglob("*"))
    load_robot_dataset(tmp_path / "output", 20)


def spoil(root, column, row, entry):
    """Write a number that is missing into a dataset of one data file."""
    [path] = (root / "data").rglob("*.parquet")
    table = pq.read_table(path)
    values = np.array(table[column].to_pylist(), np.float32)
    values[row, entry] = np.nan
    place = table.column_names.index(column)
    pq.write_table(
        table.set_column(place, column, pa.array(values.tolist(), table.schema.field(column).type)), path
    )
    return root


def test_numbers_that_are_not_used_may_be_missing(images, tmp_path):
    root = spoil(shutil.copytree(images[0], tmp_path / "state"), "observation.state", 5, 3)
    stats = json.loads((root / "meta/stats.json").read_text())
    stats["observation.state"]["mean"][3] = float("nan")
    (root / "meta/stats.json").write_text(json.dumps(stats))
    add_dynamics(root, tmp_path / "fewer", columns=[0, 1])
    copied = json.loads((tmp_path / "fewer/meta/stats.json").read_text())
    assert np.isnan(copied["observation.state"]["mean"]).tolist() == [False, False, False, True]
    with pytest.raises(ValueError, match="observation.state .* in row 5, episode 0"):
        add_dynamics(root, tmp_path / "all")
    root = spoil(shutil.copytree(images[1], tmp_path / "old"), "dynamics.velocity", 3, 1)
    found = add_dynamics(root, tmp_path / "new", columns=[0, 1, 2], angles=[2], replace=True)
    assert found["differences"].keys() == {"position", "acceleration"}
    assert np.isfinite(read_column(tmp_path / "new", "dynamics.velocity")).all()


def test_uneven_timestamps_are_found_before_the_frames_are_read(images, tmp_path):
    root = shutil.copytree(images[0], tmp_path / "uneven")
    [path] = (root / "data").rglob("*.parquet")
    table = pq.read_table(path)
    time, place = table["timestamp"].to_numpy().copy(), table.column_names.index("timestamp")
    time[[40, -5]] += 0.3 / FPS  # in the second episode and in the last one
    field = table.schema.field("timestamp")
    pq.write_table(table.set_column(place, "timestamp", pa.array(time, field.type)), path)
    with pytest.raises(ValueError, match="uniform .* episodes 1, 3; use --method central"):
        add_dynamics(root, tmp_path / "tracked", source="tracks")
    add_dynamics(root, tmp_path / "derived")


def test_radians_that_are_said_to_be_degrees_are_refused(images, tmp_path):
    with pytest.raises(ValueError, match="angle angle .* jumps by 2 pi, .* leave out --period"):
        add_dynamics(images[0], tmp_path / "wrong", columns=[0, 1, 2], angles=[2], period=360)


def test_a_dataset_is_complete_without_its_page(images, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").touch()
    main(Config(dataset=str(images[0]), output=tmp_path / "new"))
    assert "no page in runs" in capsys.readouterr().out and (tmp_path / "new/meta/dynamics.json").exists()


def test_a_folder_and_columns_that_exist_are_refused(images, tmp_path):
    result = run(tmp_path, "add_dynamics", "--dataset", images[0], "--output", images[1])
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)
    assert str(images[1]) in result.stderr
    with pytest.raises(ValueError, match=r"dynamics\.position.*--replace"):
        main(Config(dataset=str(images[1]), output=tmp_path / "again"))
