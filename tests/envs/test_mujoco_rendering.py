"""Frames of MuJoCo scenes: what is drawn, what is hidden, and what happens where nothing can be drawn."""

import numpy as np
import pytest
from own_task import check_renderer

mujoco = pytest.importorskip("mujoco", reason="uv pip install -e '.[mujoco]'")

from dynmap_rl.envs.mujoco import rendering  # noqa: E402
from dynmap_rl.envs.mujoco.rendering import Camera, FrameRenderer, find_heavy, find_parts  # noqa: E402

CAMERAS = Camera("front", (0, 0, 0.1), 1.5, 90, -30), Camera("top", (0, 0, 0.1), 1.5, 90, -90)


def make_model(faces=40):
    """Return a model with a red mesh of about 2 ``faces`` squared faces, and a blue box that is attached to it."""
    angle = np.linspace(0, 2 * np.pi, faces, endpoint=False)
    height = np.linspace(-0.9, 0.9, faces)
    rings = [
        (np.sqrt(1 - h * h) * np.cos(a), np.sqrt(1 - h * h) * np.sin(a), h) for h in height for a in angle
    ]
    vertices = " ".join(f"{0.2 * value:.4f}" for point in rings for value in point)
    return mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <asset><mesh name="ball" vertex="{vertices}"/></asset>
  <worldbody>
    <light pos="0 -1 2"/>
    <geom type="plane" size="2 2 0.1" rgba="0.9 0.9 0.9 1"/>
    <body name="arm" pos="-0.3 0 0.2"><geom type="mesh" mesh="ball" rgba="1 0 0 1"/>
      <body name="part" pos="0.6 0 0"><geom type="box" size="0.1 0.1 0.1" rgba="0 0 1 1"/></body></body>
  </worldbody>
</mujoco>""")


def draw(model, cameras=CAMERAS[:1], size=64, hide=()):
    check_renderer()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return FrameRenderer(model, cameras, size, hide).draw(data)


def count(frame, channel):
    others = [c for c in range(3) if c != channel]
    return int((frame[..., channel] > 60 + frame[..., others].max(-1).astype(int)).sum())


@pytest.mark.parametrize("size", [64, 96, 128])
def test_frames_of_cameras_stand_side_by_side(size):
    both, one = draw(make_model(), CAMERAS, size), draw(make_model(), CAMERAS[1:], size)
    assert both.shape == (size, 2 * size, 3) and both.dtype == np.uint8
    assert (both[:, size:] == one).all() and (both[:, :size] != one).any()


def test_a_renderer_that_goes_while_another_draws_does_not_disturb_it(monkeypatch):
    check_renderer()
    model, gone = make_model(), [FrameRenderer(make_model(), CAMERAS, 64)]
    data, renderer, update = mujoco.MjData(model), FrameRenderer(model, CAMERAS, 64), mujoco.mjv_updateScene
    mujoco.mj_forward(model, data)
    expected, renderer.frame[:] = renderer.draw(data), 0

    def update_and_collect(*arguments):
        gone.clear()  # the last reference
        return update(*arguments)

    monkeypatch.setattr(mujoco, "mjv_updateScene", update_and_collect)
    assert (renderer.draw(data) == expected).all() and len(rendering.UNUSED) == 1
    renderer.draw(data)
    assert not rendering.UNUSED


def test_the_sky_is_above():
    frame = draw(make_model())
    assert frame[0].max() < 60 < frame[-1].min()  # without a skybox, black


def test_heavy_meshes_are_hidden_unless_they_are_kept():
    model = make_model()
    heavy = find_heavy(model)
    assert [model.geom(geom).type.item() for geom in heavy] == [mujoco.mjtGeom.mjGEOM_MESH]
    assert find_heavy(model, ("arm",)) == [] == find_heavy(make_model(10))
    shown, hidden = draw(model), draw(model, hide=heavy)
    assert count(shown, 0) > 50 and count(hidden, 0) == 0
    assert count(shown, 2) == count(hidden, 2) > 20


def test_parts_of_a_body_belong_to_it():
    model = make_model()
    arm, part = (model.body(name).id for name in ("arm", "part"))
    assert find_parts(model, ("arm",)) >= {arm, part}
    assert find_parts(model, ("part",)) & {arm, part} == {part}
    assert not find_parts(model, ())
    with pytest.raises(ValueError, match="'leg'.*'arm'"):
        find_parts(model, ("leg",))


def test_a_machine_that_cannot_draw_says_what_to_install(monkeypatch):
    monkeypatch.setattr(rendering, "BACKENDS", ("nowhere", "nothing"))
    for library, backend in (("libEGL.so.1", "nowhere"), (None, "nothing")):
        monkeypatch.setattr(rendering, "find_library", lambda name, library=library: library)
        with pytest.raises(OSError, match=rf"\({backend}: .*libosmesa6"):
            FrameRenderer(make_model(10), CAMERAS, 64)
