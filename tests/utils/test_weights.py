"""Weights are read completely or not at all, and a file's header is checked before it is used."""

import subprocess
import sys

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from dynmap_rl.utils.weights import fingerprint, load_module, save_weights


def make():
    return nn.Linear(3, 2)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "new/w.safetensors"
    save_weights(path, make())
    return path


def test_round_trip(path):
    module = make()
    save_weights(path, module)
    assert fingerprint(load_module(path, make)) == fingerprint(module) != fingerprint(make())
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("other", [lambda: nn.Linear(4, 2), lambda: nn.Linear(3, 2, bias=False)])
def test_weights_that_do_not_fit_are_refused(path, other):
    with pytest.raises(ValueError, match=r"w\.safetensors"):
        load_module(path, other)


def test_missing_weights_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"absent\.safetensors"):
        load_module(tmp_path / "absent.safetensors", make)


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"x" * len(b)])
def test_a_damaged_file_is_named(path, damage):
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=r"w\.safetensors"):
        load_module(path, make)


def test_a_header_with_wrong_sizes_is_refused(tmp_path):
    path = tmp_path / "w.safetensors"
    save_file({"weight": torch.ones(2, 3), "bias": torch.ones(2)}, path)
    path.write_bytes(path.read_bytes().replace(b'"shape":[2,3]', b'"shape":[9,9]'))
    with pytest.raises(ValueError, match=r"w\.safetensors"):
        load_module(path, lambda: nn.Linear(9, 9))


@pytest.mark.slow
def test_a_pickle_in_the_place_of_weights_is_not_run(tmp_path):
    """Neither as weights nor as a training state."""
    from dynmap_rl.runs.folder import load_training_state

    code = (
        "import sys, torch; from pathlib import Path; folder = Path(sys.argv[1])\n"
        'class Bad:\n    def __reduce__(self): return exec, (f\'open({str(folder / "ran")!r}, "w")\',)\n'
        "torch.save({'model': Bad(), 'rng': torch.get_rng_state()}, folder / 'state.pt')"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True)
    for load in (load_training_state, lambda path: load_module(path, make)):
        with pytest.raises(ValueError, match=r"state\.pt"):
            load(tmp_path / "state.pt")
    assert not (tmp_path / "ran").exists()
    torch.load(tmp_path / "state.pt", weights_only=False)
    assert (tmp_path / "ran").exists(), "the file would have run code"
