"""Constants of normalisation."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.data.normalization import (
    layout_constants,
    normalization_constants,
    planar_range,
    value_range,
)
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


def test_one_value_in_two_thousand_does_not_widen_a_range():
    values = np.full((2000, 2), 0.5)
    values[:1000], values[7] = 0.4, 9.0
    assert planar_range("goal", values)["high"] == [1.0, 1.0]
    assert value_range(values)["high"] == pytest.approx([0.5, 0.5])


def test_ranges_in_space_are_shared_by_x_y_and_z_and_not_too_narrow():
    point, turn, axis = (tuple(f"a_{kind}{xyz}" for xyz in "xyz") for kind in ("", "omega_", "axis_"))
    layout = SimpleNamespace(action_limit=(1.0,), state=("goal_x", "goal_y", "goal_z"), goal_size=3)
    layout.dynamics = {"velocity": point + turn, "position": point + axis}
    velocity = torch.zeros(1, 2000, 6)
    velocity[0, :1000, 0], velocity[0, 1000:, 0], velocity[0, 7] = 1.0, -1.0, 50.0
    dynamics = {"velocity": velocity, "position": torch.zeros(1, 2000, 6)}
    episodes = TensorDict({"goal": torch.zeros(1, 2000, 3), "dynamics": dynamics}, [1, 2000])
    found = layout_constants(episodes, layout)
    assert found["velocity"]["high"] == pytest.approx(
        [1.0] * 3 + [1.0] * 3
    )  # the widest, and 2 rad/s at least
    assert found["position"]["high"] == pytest.approx([0.05] * 3 + [1.0] * 3)
    assert found["goal"]["low"] == pytest.approx([-0.05] * 3)
    velocity.zero_()
    assert layout_constants(episodes, layout)["velocity"]["high"] == pytest.approx([0.1] * 3 + [1.0] * 3)


def test_entries_that_do_not_come_in_threes_have_ranges_of_their_own():
    layout = SimpleNamespace(action_limit=(1.0,), state=("goal_x", "goal_y"), goal_size=2)
    layout.dynamics = {"position": ("a_x", "a_y")}
    values = torch.stack([torch.linspace(0, 1, 2001), torch.linspace(0, 9, 2001)], -1)[None]
    found = layout_constants(
        TensorDict({"goal": values, "dynamics": {"position": values}}, [1, 2001]), layout
    )
    assert found["goal"]["high"] == found["position"]["high"] == pytest.approx([1.0, 9.0], rel=0.01)
