"""Dynamics of bodies in three dimensions, on a body that spins and falls freely."""

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="uv pip install -e '.[mujoco]'")

from dynmap_rl.envs.mujoco.bodies import Body, BodyReader  # noqa: E402

XML = """
<mujoco>
  <option timestep="0.001" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="box" pos="0.1 0.2 3"><freejoint/><geom name="side" pos="0.3 0 0" type="sphere" size="0.1"/>
      <site name="tip" pos="0 0 0.5"/></body>
  </worldbody>
</mujoco>"""


def simulate(bodies, spin, steps=2000):
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    data.qvel[3:] = spin
    mujoco.mj_forward(model, data)
    reader, rows, matrices = BodyReader(model, bodies), [], []
    for _ in range(steps):
        rows.append(np.concatenate(reader.read(data)))
        matrices.append(data.body("box").xmat.reshape(3, 3).copy())
        mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
    size = sum(len(body.position_names) for body in bodies)
    rows = np.array(rows)
    return rows[:, :size], rows[:, size:], np.array(matrices)


def test_names_and_entries_agree():
    for orientation, sizes in (("full", (9, 6)), ("axis", (6, 6)), ("none", (3, 3))):
        body = Body("box", orientation=orientation)
        position, velocity, _ = simulate([body], (0, 0, 1), 1)
        assert (position.shape[1], velocity.shape[1]) == sizes
        assert (len(body.position_names), len(body.velocity_names)) == sizes


def test_orientation_is_two_columns_of_the_rotation_matrix_and_never_jumps():
    position, _, matrices = simulate([Body("box")], (0, 0, 7))
    np.testing.assert_array_equal(position[:, 3:6], matrices[:, :, 0])
    np.testing.assert_array_equal(position[:, 6:], matrices[:, :, 1])
    assert matrices[:, 0, 0].min() < -0.99  # more than half a turn
    assert np.abs(np.diff(position[:, 3:], axis=0)).max() < 0.01


def test_velocities_are_the_rates_of_points_and_axes():
    position, velocity, _ = simulate([Body("box"), Body("tip", orientation="axis")], (2, 3, 1))
    for place, speed in ((0, 0), (9, 6)):
        rate = np.diff(position[:, place : place + 3], axis=0) / 0.001
        assert np.abs(rate - velocity[1:, speed : speed + 3]).max() < 0.02
    turn = np.cross(velocity[:, 3:6], position[:, 3:6])  # of the x axis
    assert np.abs(np.diff(position[:, 3:6], axis=0) / 0.001 - turn[:-1]).max() < 0.05
    axis, omega = position[:, 12:], velocity[:, 9:]
    assert np.abs((axis * omega).sum(1)).max() < 1e-12  # no part about the axis
    assert np.abs(np.diff(axis, axis=0) / 0.001 - np.cross(omega, axis)[:-1]).max() < 0.05


def test_a_geom_gives_place_and_velocity_to_a_body_without_a_name():
    position, velocity, _ = simulate([Body("ball", "side", "none")], (0, 0, 5), 10)
    np.testing.assert_allclose(position[0], (0.4, 0.2, 3))
    np.testing.assert_allclose(velocity[0], (0, 1.5, 0), atol=1e-9)


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"'cup'.*box"):
        BodyReader(mujoco.MjModel.from_xml_string(XML), [Body("cup")])
    with pytest.raises(ValueError, match="orientation"):
        Body("box", orientation="euler")


def test_what_is_read_is_of_the_present_and_not_of_the_last_substep():
    model = mujoco.MjModel.from_xml_string(XML)
    data, present = mujoco.MjData(model), mujoco.MjData(model)
    data.qvel[3:] = 2, 3, 1
    reader = BodyReader(model, [Body("box"), Body("tip", orientation="axis"), Body("ball", "side", "none")])
    mujoco.mj_step(model, data, nstep=20)
    present.qpos, present.qvel = data.qpos, data.qvel
    mujoco.mj_forward(model, present)
    late = data.xpos.copy()
    for found, expected in zip(reader.read(data), reader.read(present), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert not np.array_equal(late, present.xpos)


def test_mocap_bodies_are_refused():
    xml = """<mujoco><worldbody><body name="hand" mocap="true"><geom name="palm" size="0.1"/>
      <body name="tool"><geom size="0.1"/></body></body></worldbody></mujoco>"""
    for name in ("hand", "palm", "tool"):
        with pytest.raises(ValueError, match=f"{name} is on a mocap body"):
            BodyReader(mujoco.MjModel.from_xml_string(xml), [Body(name)])
