"""Dynamics of an episode, and the new folder."""

import numpy as np
import pytest

from dynmap_rl.data.derive import _derive
from dynmap_rl.data.format.columns import new_folder
from dynmap_rl.data.motion import Motion

EVEN = np.arange(20) / 25


def test_an_angle_in_degrees_jumps_by_360():
    angle = (400 * EVEN[:, None] + 180) % 360 - 180  # 16 in a step, which is not a jump
    found, _ = _derive(Motion(angle, [0], 360), EVEN, "central", 11, 3)
    np.testing.assert_allclose(found["velocity"], 400)


def test_the_acceleration_of_a_measured_velocity_is_its_derivative():
    velocity = np.stack([2 - 6 * EVEN, EVEN], 1)
    found, motion = _derive(Motion(0 * velocity, [], velocity=velocity), EVEN, "central", 11, 3)
    np.testing.assert_allclose(found["acceleration"], np.broadcast_to([-6.0, 1.0], (20, 2)))
    assert found["velocity"] is velocity and not motion.other.any()


def test_two_commands_do_not_write_one_folder(tmp_path):
    """The second one is refused, and the first one goes on."""
    with new_folder(tmp_path / "new") as folder:
        (folder / "data").mkdir()
        with pytest.raises(ValueError, match="another process"), new_folder(tmp_path / "new"):
            pass
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["data"]


def test_what_a_killed_command_has_left_is_deleted(tmp_path):
    left = tmp_path / ".new.add_dynamics"
    (left / "data").mkdir(parents=True)
    (left / "half.json").touch()
    with new_folder(tmp_path / "new") as folder:
        (folder / "whole.json").touch()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["whole.json"]
    with pytest.raises(ValueError, match="damaged"), new_folder(tmp_path / "other"):
        raise ValueError("damaged")
    assert [path.name for path in tmp_path.iterdir()] == ["new"]
