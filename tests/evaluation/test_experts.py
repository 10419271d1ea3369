"""Rates of experts."""

from types import SimpleNamespace

import numpy as np
import pytest
from point_task import LIMIT, Point

from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.evaluation.experts import fresh_scenes, judge_demonstrator, rates, rates_text


def test_rates_are_means_over_worlds():
    worlds = [SimpleNamespace(dropped=i == 0, position_error=0.01 * i, good=i > 1) for i in range(4)]
    found = rates(SimpleNamespace(is_success=lambda world: world.good), worlds)
    assert found == {"success": 0.5, "drop": 0.25, "position_error": pytest.approx(0.015), "episodes": 4}
    assert "50.0 %" in rates_text(found) and "25.0 %" in rates_text(found)


class Hasty(Point):
    """A point whose demonstrator asks for more than the limit of the actions."""

    def __init__(self):
        self.actions, self.closed = [], 0

    def demonstrator(self, world):
        return lambda: np.full(2, 5 * LIMIT)

    def step(self, worlds, actions):
        self.actions += actions
        super().step(worlds, actions)

    def close(self, world):
        self.closed += 1


def test_a_demonstrator_is_judged_within_the_limits_of_recordings():
    task = Hasty()
    judge_demonstrator(task, range(3))
    np.testing.assert_allclose(task.actions, np.full((30, 2), LIMIT), rtol=1e-6)
    assert task.closed == 1


def test_scenes_of_checkpoints_are_no_test_scenes():
    assert len(set(fresh_scenes(50))) == 50
    assert not set(fresh_scenes(50)) & {*scene_seeds("test", 2000), *scene_seeds("validation", 2000)}
