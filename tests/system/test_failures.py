"""Failures of every kind: one line that names the cause, exit code 2, and no half-written file.

A folder of the kernel stands in for one that cannot be written to, which holds for root too.
"""

import json
import re
import shutil
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commands import PRESETS, run
from safetensors.torch import load_file, save_file

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="folders of Linux' kernel")
DATA, RUN = "datasets/balance_reaching", "runs/decoupled/balance_reaching/position_velocity_recurrent"
AGAIN = f"decoupled --config_path {PRESETS}/decoupled.yaml"
TRAIN = f"{AGAIN} --run runs/new"
GENERALIZE = "generalize --task bin_dropping --pretrained"
EVALUATE = f"evaluate --policy {RUN} --eval.episodes 1"


@pytest.fixture
def place(small_run, tmp_path):
    """Return a folder with a dataset and a finished run, which may be damaged."""
    return shutil.copytree(small_run, tmp_path, dirs_exist_ok=True)


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
    (nothing, "decoupled --dataset datasets/none", "datasets/none"),
    (nothing, "decoupled --dataset nobody/nothing", "nobody/nothing"),
    (nothing, f"add_dynamics --dataset {RUN} --output out", RUN),
    (lambda p: truncate(data_file(p)), TRAIN, r"\.parquet"),
    (lambda p: data_file(p).unlink(), TRAIN, DATA),
    (another_schema, TRAIN, r"dynamics\.velocity"),
    (frames_of_another_size, TRAIN, r"\(96, 96, 3\)"),
    (nan_in_the_actions, TRAIN, "action"),
    (lambda p: truncate(p / DATA / "meta/info.json"), TRAIN, r"info\.json"),
    (lambda p: truncate(p / DATA / "meta/dynmap.json"), TRAIN, r"dynmap\.json"),
    (other_json(f"{DATA}/meta/info.json"), TRAIN, r"info\.json.* dict, got \[\]"),
    (
        other_json(f"{DATA}/meta/info.json", '{"codebase_version": "v3.0", "total_frames": 720}'),
        f"robot --dataset {DATA}",
        r"info\.json, features",
    ),
    (other_json(f"{DATA}/meta/dynmap.json"), TRAIN, r"dynmap\.json.* dict, got \[\]"),
    (no_column, TRAIN, "action"),
    (
        nothing,
        f"{TRAIN} --task bin_dropping --dataset {DATA}",
        "must be a dataset of bin_dropping, got one of balance_reaching",
    ),
    (lambda p: change_json(p / DATA / "meta/dynmap.json", kind="exploration"), TRAIN, "exploration"),
    (nothing, f"collect --output {DATA} --episodes 9", "episodes 4 instead of 9"),
    (nothing, "collect --output runs", "runs"),
    # Runs and checkpoints.
    (
        lambda p: truncate(p / RUN / "world_model/weights.safetensors"),
        EVALUATE,
        r"world_model/weights\.safetensors",
    ),
    (
        lambda p: truncate(p / RUN / "seed_0/policy/weights.safetensors"),
        EVALUATE,
        r"policy/weights\.safetensors",
    ),
    (lambda p: truncate(p / RUN / "seed_0/policy/arguments.json"), EVALUATE, r"arguments\.json"),
    (lambda p: truncate(p / RUN / "config.json"), EVALUATE, r"config\.json"),
    (other_json(f"{RUN}/config.json"), EVALUATE, r"config\.json.* dict, got \[\]"),
    (other_json(f"{RUN}/config.json", '{"task": 1}'), EVALUATE, r"config\.json: task must be a name, got 1"),
    (
        lambda p: change_json(p / RUN / "config.json", task=None, dataset="datasets/robot"),
        EVALUATE,
        "datasets/robot",
    ),
    (lambda p: change_json(p / RUN / "config.json", task="this:s"), EVALUATE, "--task this:s"),
    (lambda p: change_json(p / RUN / "config.json", task="os:abort"), f"play --policy {RUN}", "os:abort"),
    (other_json(f"{RUN}/config.json"), AGAIN, r"config\.json.* dict, got \[\]"),
    (lambda p: (p / RUN / "eval.json").unlink(), f"{GENERALIZE} {RUN}", f"{RUN} holds no finished run"),
    (other_json(f"{RUN}/eval.json"), f"{GENERALIZE} {RUN}", r"eval\.json.* dict, got \[\]"),
    (other_json(f"{RUN}/eval.json", '{"world_model": []}'), f"{GENERALIZE} {RUN}", RUN),
    (other_json(f"{RUN}/world_model/arguments.json"), EVALUATE, r"arguments\.json.* dict, got \[\]"),
    (weights_of_another_size, EVALUATE, r"weights\.safetensors"),
    (half_a_run, AGAIN, r"world_model\.pt"),
    (lambda p: truncate(p / RUN / "eval.json"), AGAIN, r"eval\.json"),
    (nothing, f"{AGAIN} --world_model.beta_z 2", r"world_model\.beta_z: 0\.1 there, 2\.0 here"),
    (nothing, f"{EVALUATE} --seed 3", "seed_3"),
    (nothing, "evaluate --policy runs/none", "runs/none"),
    (nothing, "evaluate --expert bin_dropping", "bin_dropping, which balance_reaching does not"),
    # Options.
    (nothing, f"{TRAIN} --bogus 1", "--bogus; see --help"),
    (
        nothing,
        f"{TRAIN} --updates 3",
        r"--updates; do you mean --world_model\.updates or --policy\.updates or",
    ),
    (nothing, f"{TRAIN} --world_model.update 3", r"do you mean --world_model\.updates\?"),
    (nothing, f"{TRAIN} --policy.corrections -1", r"corrections must be at least 0, got -1"),
    (nothing, f"{TRAIN} --world_model.updates many", r"world_model\.updates.*'many'"),
    (nothing, f"{TRAIN} --world_model.supervision speed", "supervision must .*'speed'"),
    (nothing, f"{TRAIN} --policy.kind transformer", "kind must .*'transformer'"),
    (nothing, f"{TRAIN} --eval.split train", "split must .*'train'"),
    (nothing, f"{TRAIN} --task juggling", "juggling"),
    (nothing, f"{TRAIN} --seeds a", "--seeds must .*'a'"),
    (nothing, f"{TRAIN} --compute.device tpu", "device must .*'tpu'"),
    (nothing, f"{TRAIN} --compute.threads 0", "threads must be at least 1, got 0"),
    (nothing, f"{TRAIN} --logger paper", "--logger must .*'paper'"),
    (nothing, "collect --episodes 0", "episode"),
    (nothing, "expert --ppo.num_envs 0", "num_envs must be at least 1, got 0"),
    (nothing, "tables --launcher slurm", "--launcher"),
    (nothing, "tables --only nothing", "'nothing'"),
    (nothing, "tables --dry_run --workers 0", "workers must be at least 1, got 0"),
    (nothing, "tables --gpus 1", "--gpus has no effect with --launcher local"),
    (nothing, "figures --only fig99", "fig99"),
    (nothing, "play --driver nobody", "--driver"),
    # Folders.
    (nothing, f"{TRAIN} --run /sys/run", "/sys/run.*; choose a folder that can be written to"),
    (nothing, "collect --output /sys/data", "/sys/data"),
    pytest.param(
        nothing,
        f"{EVALUATE} --output /sys/result.json",
        "/sys/result.json.*; choose a folder that can be",
        marks=pytest.mark.slow,
    ),
    (nothing, f"{TRAIN} --run {DATA}/meta/info.json", r"info\.json.*; choose another path"),
    # Training.
    (nothing, f"{TRAIN} --world_model.learning_rate 1e9", "lower learning rate"),
    (
        nothing,
        f"expert --config_path {PRESETS}/expert.yaml --ppo.learning_rate 1e9",
        "lower learning rate",
    ),
]


def files(folder):
    return {
        str(path.relative_to(folder)): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()
    }


@pytest.mark.parametrize(
    ("arrange", "command", "message"),
    CASES,
    ids=[getattr(case, "values", case)[1].replace(f"{PRESETS}/", "") for case in CASES],
)
def test_the_cause_is_one_line(place, monkeypatch, arrange, command, message):
    monkeypatch.setattr("dynmap_rl.training.dataset.record_dataset", None)  # would take minutes
    arrange(place)
    before = files(place)
    result = run(place, *command.split())
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.returncode == 2, result.stderr
    assert len(errors) == 1 and re.search(message, errors[0]), result.stderr
    assert "Traceback" not in result.stderr
    after = files(place)
    assert {name: after.get(name) for name in before} == before, "existing files stay as they are"
    for path in place.rglob("*"):
        assert not path.name.endswith(".tmp"), path
        if path.suffix == ".json" and str(path.relative_to(place)) not in before:
            json.loads(path.read_text())


@pytest.mark.parametrize(
    ("module", "command", "message"),
    [
        (
            "ray",
            "tables --launcher ray --only joint_none --results results",
            r"pip install -e '\.\[ray\]'",
        ),
        ("ray", "joint --compute.launcher ray --compute.ranks 2", r"pip install -e '\.\[ray\]'"),
        ("dynmap_rl.integrations.lerobot", "evaluate --policy datasets", r"pip install -e '\.\[lerobot\]'"),
    ],
)
def test_an_extra_that_is_not_installed(place, monkeypatch, module, command, message):
    monkeypatch.setitem(sys.modules, module, None)
    recorded = []
    monkeypatch.setattr("dynmap_rl.training.dataset.record_dataset", lambda *given: recorded.append(given))
    result = run(place, *command.split())
    assert result.returncode == 2 and re.search(message, result.stderr), result.stderr
    assert "Traceback" not in result.stderr and not recorded
