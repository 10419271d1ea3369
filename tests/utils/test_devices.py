import random

import numpy as np
import pytest
import torch

from dynmap_rl.utils.devices import Compute, choose_device, seed_everything


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


@pytest.mark.parametrize("settings", [{"device": "tpu"}, {"threads": 0}])
def test_settings_are_checked(settings):
    with pytest.raises(ValueError, match=rf"Compute\.{next(iter(settings))} must be"):
        Compute(**settings)
