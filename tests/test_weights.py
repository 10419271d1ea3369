"""Weights are read whole or not at all, and what a file says is not believed before it is checked."""

import json
import subprocess
import sys

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from dynmap_rl.modules.world_model import WorldModel
from dynmap_rl.modules import checkpoints  # MODULE
from dynmap_rl.modules.checkpoints import load_policy
from dynmap_rl.modules.checkpoints import load_world_model
from dynmap_rl.runs.lookup import SHIPPED
from dynmap_rl.utils.weights import load_module
from dynmap_rl.utils.weights import save_weights

RUN = SHIPPED / "balance_reaching"


def test_round_trip(tmp_path):
    module = nn.Linear(3, 2)
    save_weights(tmp_path / "new/w.safetensors", module)
    other = load_module(tmp_path / "new/w.safetensors", lambda: nn.Linear(3, 2))
    assert torch.equal(module.weight, other.weight) and torch.equal(module.bias, other.bias)
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["w.safetensors"]


def test_weights_that_do_not_fit_raise(tmp_path):
    save_weights(tmp_path / "w.safetensors", nn.Linear(3, 2))
    for make in (lambda: nn.Linear(4, 2), lambda: nn.Linear(3, 2, bias=False)):
        with pytest.raises(
            ValueError, match=r"w\.safetensors does not hold this model's weights: other names"
        ):
            load_module(tmp_path / "w.safetensors", make)
    with pytest.raises(ValueError, match=r"no weights at .*absent\.safetensors"):
        load_module(tmp_path / "absent.safetensors", lambda: nn.Linear(3, 2))


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"x" * len(b)])
def test_a_damaged_file_is_named(tmp_path, damage):
    path = tmp_path / "w.safetensors"
    save_weights(path, nn.Linear(3, 2))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"w\.safetensors"):
        load_module(path, lambda: nn.Linear(3, 2))


@pytest.fixture
def copies(tmp_path):
    """A world model and a policy whose arguments can be changed."""

    def copy(name, **arguments):
        source, target = RUN / name, tmp_path / name
        target.mkdir(parents=True)
        (target / "weights.safetensors").symlink_to(source / "weights.safetensors")
        stored = json.loads((source / "arguments.json").read_text())
        (target / "arguments.json").write_text(json.dumps(stored | arguments))
        return target

    return copy


@pytest.mark.parametrize(
    "arguments",
    [
        {"hidden_size": 500},
        {"hidden_size": 10**6},
        {"hidden_size": 10**18},
        {"latent_size": -1},
        {"latent_size": "64"},
        {"action": 10**12},
        {"dynamics": {"position": 10**12}},
        {"dynamics": ["position"]},
        {"dynamics": {"../../out": 6}},
        {"unknown": 1},
    ],
)
def test_arguments_that_lie_are_refused_before_memory_is_taken(copies, monkeypatch, arguments):
    """Only a module without memory is made, on the meta device."""
    folder, made = copies("world_model", **arguments), []

    def make(**arguments):
        made.append(torch.empty(0).device.type)
        return WorldModel(**arguments)

    monkeypatch.setattr(checkpoints, "WorldModel", make)
    with pytest.raises(ValueError, match="weights.safetensors does not hold this model's weights"):
        load_world_model(folder)
    assert made in ([], ["meta"])
    made.clear()
    load_world_model(RUN / "world_model")
    assert made == ["meta", "cpu"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 10**9}, "does not hold this model's weights"),
        ({"goal": None}, "does not hold this model's weights"),
        ({"kind": "os.system"}, "unknown policy 'os.system'"),
        ({"kind": ["recurrent"]}, "unknown policy"),
    ],
)
def test_a_policys_arguments_are_checked_too(copies, arguments, message):
    with pytest.raises(ValueError, match=message):
        load_policy(copies("seed_0/policy", **arguments))


def test_arguments_that_are_no_arguments_are_refused(copies):
    folder = copies("world_model")
    (folder / "arguments.json").write_text('["dynamics"]')
    with pytest.raises(ValueError, match=r'arguments.json is \["dynamics"\], not of the type dict'):
        load_world_model(folder)


def test_a_pickle_in_the_place_of_weights_is_not_run(tmp_path):
    """Neither as weights nor as a training state."""
    code = (
        "import sys, torch; from pathlib import Path; folder = Path(sys.argv[1])\n"
        'class Bad:\n    def __reduce__(self): return exec, (f\'open({str(folder / "ran")!r}, "w")\',)\n'
        "torch.save({'model': Bad(), 'rng': torch.get_rng_state()}, folder / 'state.pt')"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    from dynmap_rl.runs.folder import load_training_state

    for load in (load_training_state, lambda path: load_module(path, lambda: nn.Linear(3, 2))):
        with pytest.raises(ValueError, match="state.pt"):
            load(tmp_path / "state.pt")
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "state.pt", weights_only=False)
    assert (tmp_path / "ran").exists(), "it would have"


def test_a_header_that_lies_about_sizes_is_refused(tmp_path):
    path = tmp_path / "w.safetensors"
    save_file({"weight": torch.ones(2, 3), "bias": torch.ones(2)}, path)
    data = path.read_bytes().replace(b'"shape":[2,3]', b'"shape":[9,9]')
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"w\.safetensors does not hold"):
        load_module(path, lambda: nn.Linear(9, 9))
