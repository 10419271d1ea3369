import random

import numpy as np
import pytest
import torch

from dynmap_rl.utils.devices import Compute, RankedCompute, choose_device, device_name, seed_everything


def test_seeding_covers_every_generator():
    def draw():
        seed_everything(11)
        return random.random(), np.random.rand(), torch.rand(1).item()

    assert draw() == draw()


@pytest.mark.parametrize("gpu", [False, True])
def test_auto_is_the_gpu_where_there_is_one(monkeypatch, gpu):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert choose_device("auto").type == ("cuda" if gpu else "cpu")
    assert choose_device("cpu").type == "cpu"
    if not gpu:
        with pytest.raises(ValueError, match="cuda"):
            choose_device("cuda")


def test_results_name_the_gpu_that_they_were_computed_on(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"NVIDIA {device.type}")
    assert device_name("auto") == "NVIDIA cuda"
    assert device_name("cpu") == "cpu"


@pytest.mark.parametrize("settings", [{"device": "tpu"}, {"threads": 0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=rf"Compute\.{next(iter(settings))} must be"):
        Compute(**settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"launcher": "slurm"}, "launcher must be one of local, ray"),
        ({"launcher": "ray", "ranks": 0}, "ranks must be at least 1"),
        ({"ranks": 2}, r"--compute\.ranks has no effect with --compute\.launcher local"),
    ],
)
def test_settings_of_ranks_are_checked(monkeypatch, settings, message):
    monkeypatch.setattr("dynmap_rl.utils.cluster.find_spec", lambda name: name)
    with pytest.raises(ValueError, match=message):
        RankedCompute(**settings)
