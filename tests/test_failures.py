"""What can go wrong for a user, case by case: one line that says what to do, exit code 2, nothing half-written.

Disks that are full are imitated by a limit on the size of a file, read-only folders by one of the kernel's: both hold
for root too.
"""

import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import run
from safetensors.torch import load_file, save_file

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="limits and folders of Linux' kernel")
RECIPES = Path(__file__).parents[1] / "recipes"
DATA, RUN = "datasets/mine", "runs/mine"
TRAIN = f"decoupled --smoke --dataset {DATA} --run runs/new"
EVALUATE = f"evaluate --policy {RUN} --episodes 1"


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    """A dataset and a run that is done, not to be written to."""
    folder = tmp_path_factory.mktemp("finished")
    shutil.copytree(recording, folder / DATA)
    result = run(folder, "decoupled", "--smoke", "--dataset", DATA, "--run", RUN)
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture
def place(finished, tmp_path):
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return tmp_path


def data_file(place):
    return next((place / DATA / "data").rglob("*.parquet"))


def truncate(path, share=0.5):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def change_json(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def nan_in_the_actions(place):
    path = data_file(place)
    table = pq.read_table(path)
    values = np.array(table["action"].to_pylist(), np.float32)
    values[7] = np.nan
    column = pa.array(values.tolist(), table.schema.field("action").type)
    pq.write_table(table.set_column(table.column_names.index("action"), "action", column), path)


def frames_of_another_size(place):
    path = place / DATA / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["observation.images.front"]["shape"] = [96, 96, 3]
    path.write_text(json.dumps(info))


def another_schema(place):
    path = place / DATA / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"].pop("dynamics.velocity")
    path.write_text(json.dumps(info))


def no_column(place):
    """PyArrow would leave it out without a word."""
    path = data_file(place)
    pq.write_table(pq.read_table(path).drop_columns(["action"]), path)


def other_json(name, value="[]"):
    """Valid, but not what it should be."""
    return lambda place: (place / name).write_text(value)


def weights_of_another_size(place):
    path = place / RUN / "world_model/weights.safetensors"
    save_file({name: value[..., :1].contiguous() for name, value in load_file(path).items()}, path)


def half_a_run(place):
    """Stopped after the world model's training, its training state cut short."""
    for name in ("eval.json", "seed_0", "world_model"):
        path = place / RUN / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    truncate(place / RUN / "checkpoint/world_model.pt")


def nothing(place):
    pass


CASES = [
    # Datasets.
    (nothing, "decoupled --smoke --dataset datasets/none", "no dataset at datasets/none; record one with"),
    (
        nothing,
        "generalize --smoke --task bin_dropping --world_model runs/none",
        "runs/none holds no finished run",
    ),
    (nothing, f"add_dynamics --dataset {RUN} --output out", "is not a LeRobot dataset"),
    (lambda p: truncate(data_file(p)), TRAIN, "damaged or unfinished data file"),
    (lambda p: data_file(p).unlink(), TRAIN, "is incomplete"),
    (another_schema, TRAIN, "lacks the columns dynamics.velocity; add or rename them"),
    (frames_of_another_size, TRAIN, r"frames of \(96, 96, 3\), not \(64, 64, 3\).*; resize them"),
    (nan_in_the_actions, TRAIN, "numbers in action that are missing or not finite"),
    (lambda p: truncate(p / DATA / "meta/info.json"), TRAIN, "info.json cannot be read"),
    (lambda p: truncate(p / DATA / "meta/dynmap.json"), TRAIN, "dynmap.json cannot be read"),
    (other_json(f"{DATA}/meta/info.json"), TRAIN, r"info.json is \[\], not of the type dict; restore"),
    (
        other_json(f"{DATA}/meta/info.json", '{"codebase_version": "v3.0", "total_frames": 720}'),
        f"{TRAIN} --task none",
        "info.json, features is null, not of the type dict",
    ),
    (other_json(f"{DATA}/meta/dynmap.json"), TRAIN, r"dynmap.json is \[\], not of the type dict"),
    (
        lambda p: change_json(p / DATA / "meta/dynmap.json", episodes=[{"episode_index": "0"}]),
        TRAIN,
        'dynmap.json, episodes, 0, episode_index is "0", not of the type int',
    ),
    (no_column, TRAIN, r"parquet lacks the columns action; restore it or record"),
    (nothing, f"{TRAIN} --task bin_dropping", "is of balance_reaching, not of bin_dropping"),
    (
        lambda p: change_json(p / DATA / "meta/dynmap.json", kind="exploration"),
        TRAIN,
        "is not to be imitated",
    ),
    (nothing, f"collect --output {DATA} --episodes 9", "another recording .episodes: 4 there"),
    (nothing, "collect --output runs", "runs exists"),
    # Runs and checkpoints.
    (
        lambda p: truncate(p / RUN / "world_model/weights.safetensors"),
        EVALUATE,
        "does not hold this model's weights",
    ),
    (
        lambda p: truncate(p / RUN / "seed_0/policy/weights.safetensors"),
        EVALUATE,
        "does not hold this model's",
    ),
    (
        lambda p: truncate(p / RUN / "seed_0/policy/arguments.json"),
        EVALUATE,
        "arguments.json is not valid JSON",
    ),
    (lambda p: truncate(p / RUN / "config.json"), EVALUATE, "config.json is not valid JSON"),
    (other_json(f"{RUN}/config.json"), EVALUATE, r"config.json is \[\], not of the type dict"),
    (other_json(f"{RUN}/config.json", '{"task": 1}'), EVALUATE, "config.json names no task, but 1"),
    (
        other_json(f"{RUN}/config.json"),
        f"decoupled --smoke --dataset {DATA} --run {RUN}",
        r"config.json is \[\], not of",
    ),
    (
        other_json(f"{RUN}/eval.json"),
        f"generalize --smoke --task bin_dropping --world_model {RUN}",
        r"eval.json is \[\], not of",
    ),
    (
        other_json(f"{RUN}/eval.json", '{"world_model": []}'),
        f"generalize --smoke --task bin_dropping --world_model {RUN}",
        f"{RUN} holds no finished run",
    ),
    (other_json(f"{RUN}/world_model/arguments.json"), EVALUATE, r"arguments.json is \[\], not of"),
    (weights_of_another_size, EVALUATE, "other names or shapes"),
    (
        half_a_run,
        f"decoupled --smoke --dataset {DATA} --run {RUN}",
        "world_model.pt cannot be read .* delete it",
    ),
    (
        lambda p: truncate(p / RUN / "eval.json"),
        f"decoupled --smoke --dataset {DATA} --run {RUN}",
        "not valid JSON",
    ),
    (
        nothing,
        f"decoupled --smoke --dataset {DATA} --run {RUN} --beta_z 2",
        r"other settings \(beta_z: 0.1 there",
    ),
    (nothing, f"{EVALUATE} --seed 3", "holds no checkpoint"),
    (nothing, "evaluate --policy runs/none", "no policy at runs/none; train one with"),
    (
        nothing,
        "evaluate --expert bin_dropping",
        "sees states of bin_dropping, which balance_reaching does not",
    ),
    (nothing, f"{TRAIN} --world_model {RUN} --supervision none", r"supervised on \('position', 'velocity'\)"),
    (nothing, f"{TRAIN} --task none --world_model {RUN}", "for another task use recipes/generalize.py"),
    # Options.
    (nothing, f"{TRAIN} --bogus 1", "there is no option --bogus; see --help"),
    (nothing, f"{TRAIN} --world-modell {RUN}", r"no option --world_modell; do you mean --world_model\?"),
    (nothing, f"{TRAIN} --copies -1", "--copies must not be negative"),
    (nothing, f"{TRAIN} --updates many", "Couldn.t parse .many. into an int|updates.*int"),
    (nothing, f"{TRAIN} --supervision speed", "unknown supervision"),
    (nothing, f"{TRAIN} --task juggling", "unknown task"),
    (nothing, f"{TRAIN} --policy transformer", "unknown policy"),
    (nothing, f"{TRAIN} --seeds a", "whole numbers"),
    (nothing, f"{TRAIN} --device tpu", "--device is auto, cpu or cuda"),
    (nothing, f"{TRAIN} --logger paper", "--logger is one of"),
    (nothing, "tables --launcher slurm", "--launcher is local or ray"),
    (nothing, "tables --only nothing", "no cell's name holds 'nothing'; --dry_run lists them"),
    (nothing, "tables --print pdf", "--print is markdown, json or findings, not .pdf."),
    (nothing, "figures --only fig99", "no figure fig99; choose from fig2"),
    (nothing, "play --driver nobody", "--driver is one of"),
    (nothing, "expert --num_envs 0", "num_envs must be at least 1"),
    (nothing, "collect --episodes 0", "needs at least one episode of each split"),
    (nothing, f"{TRAIN} --threads 0", "--threads must be at least 1"),
    (nothing, "expert --epochs 0", "--epochs must be at least 1"),
    (nothing, "tables --dry_run --workers 0", "--workers must be at least 1"),
    (
        lambda p: change_json(p / RUN / "config.json", task="none"),
        EVALUATE,
        "there is no simulator; its eval.json has",
    ),
    (nothing, "tables --gpus 1", "--gpus says nothing to --launcher local"),
    (lambda p: change_json(p / RUN / "config.json", task="this:s"), EVALUATE, "do so with --task this:s"),
    (
        lambda p: change_json(p / RUN / "config.json", task="os:abort"),
        f"play --policy {RUN}",
        "is no task: it is no subclass",
    ),
    # Folders.
    (nothing, f"{TRAIN} --run /sys/run", "/sys/run.*; choose a folder that can be written to"),
    (nothing, "collect --output /sys/data", "/sys/data.*may the folder be written"),
    (nothing, f"{EVALUATE} --output /sys/result.json", "/sys/result.json.*; choose a folder that can be"),
    (nothing, f"{TRAIN} --run {DATA}/meta/info.json", "info.json.; choose another path"),
    # Training.
    (
        nothing,
        f"{TRAIN} --updates 100 --learning_rate 1e9",
        "run again with a lower learning rate, in another --run",
    ),
    (
        nothing,
        "expert --num_envs 4 --minibatch 120 --epochs 2 --learning_rate 1e9",
        "the loss is not finite; what was kept before stays; run again with a lower learning rate",
    ),
]


def files(folder):
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize(("arrange", "command", "message"), CASES, ids=[case[1] for case in CASES])
def test_one_line_says_what_to_do(place, arrange, command, message):
    arrange(place)
    before = files(place)
    result = run(place, *command.split())
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.returncode == 2, result.stderr
    assert len(errors) == 1 and re.search(message, errors[0]), result.stderr
    assert "Traceback" not in result.stderr
    after = files(place)
    assert {name: after.get(name) for name in before} == before, "what was there is as it was"
    for path in place.rglob("*"):
        assert not path.name.endswith(".tmp"), path
        if path.suffix == ".json" and str(path.relative_to(place)) not in before:
            json.loads(path.read_text())


def start(place, command, without=(), **arguments):
    """A recipe as a process of its own."""
    recipe, *options = command.split()
    environment = {name: value for name, value in os.environ.items() if name not in without}
    return subprocess.Popen(
        [sys.executable, str(RECIPES / f"{recipe}.py"), *options],
        cwd=place,
        env=environment | {"TQDM_DISABLE": "1"},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        **arguments,
    )


def finish(process):
    """What it says until it ends."""
    try:
        return process.communicate(timeout=200)[1]
    finally:
        process.kill()


def weights(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.safetensors")}


def test_a_full_disk(place):
    """It holds no training state: no file of more than ``size`` bytes can be written."""
    size = 20_000_000

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    process = start(place, TRAIN, preexec_fn=limit)
    error = finish(process)
    assert process.returncode == 2, error
    assert re.fullmatch(
        r"error: .*File too large.*: '.*world_model\.pt'; make room; the same command goes .*\n", error
    )
    assert not [path.name for path in (place / "runs/new").rglob(".*") if path.name != ".lock"]

    result = run(place, *TRAIN.split())
    assert result.returncode == 0, result.stderr
    assert weights(place / "runs/new") == weights(place / RUN), "it went on as if nothing had been"


def test_features_that_do_not_fit_are_not_begun(place, monkeypatch):
    """Writing to a mapped file on a full disk would kill the process without a word."""
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    result = run(place, *TRAIN.split())
    assert result.returncode == 2
    assert re.search(r"error: .*\d MB are needed, 0 are free: .*; make room; the same command", result.stderr)
    assert not (place / "runs/new/features").exists()


def test_ctrl_c(place):
    command = f"{TRAIN} --updates 300"
    # A shell's job in the background, and with it this test, would have it ignore Ctrl-C.
    process = start(place, command, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    while not (place / "runs/new/metrics.jsonl").exists():
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.1)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    error = finish(process)
    assert (process.returncode, error) == (1, "stopped; the same command goes on where it was\n")
    assert not (place / "runs/new/eval.json").exists()


def test_no_display(place):
    process = start(place, "play --size 64", without=("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"))
    error = finish(process)
    assert process.returncode == 2
    assert "error: there is no display to open a window on" in error and "Traceback" not in error


@pytest.mark.parametrize(
    ("module", "command", "message"),
    [
        (
            "ray",
            "tables --smoke --launcher ray --only joint_none --results results",
            r"needs Ray: pip install '\.\[ray\]'",
        ),
        ("dynmap_rl.integrations.lerobot", "evaluate --policy datasets", r"pip install '\.\[lerobot\]'"),
    ],
)
def test_an_extra_that_is_not_installed(place, monkeypatch, module, command, message):
    monkeypatch.setitem(sys.modules, module, None)
    result = run(place, *command.split())
    assert result.returncode == 2 and re.search(message, result.stderr), result.stderr
    assert "Traceback" not in result.stderr


def test_debug_shows_where(place):
    with pytest.raises(ValueError, match="unknown supervision"):
        run(place, *TRAIN.split(), "--supervision", "speed", "--debug")
