"""Constants of normalisation."""

import numpy as np
import torch

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.normalization import normalization_constants
from dynmap_rl.envs.world import VELOCITY_LIMIT


def test_normalization_is_natural_and_widens_only_where_needed(recording):
    episodes = load_dataset(recording, "train")
    stored = load_meta(recording)["normalization"]
    assert stored == normalization_constants(episodes)
    assert stored["goal"] == {"low": [0.0, 0.0], "high": [1.0, 1.0]}
    assert stored["position"]["low"][:3] == [0.0, 0.0, -0.5]
    np.testing.assert_allclose(stored["velocity"]["high"][:3], VELOCITY_LIMIT)
    fast = episodes.clone()
    fast["dynamics", "velocity"][..., 3] = -2.0
    widened = normalization_constants(fast)["velocity"]
    assert (widened["low"][3], widened["high"][3]) == (-2.0, 2.0)
    assert widened["high"][:3] == stored["velocity"]["high"][:3]
    still = episodes.apply(torch.zeros_like)
    for constants in normalization_constants(still).values():
        assert (np.array(constants["low"]) < np.array(constants["high"])).all()
