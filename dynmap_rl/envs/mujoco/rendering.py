"""Small frames of MuJoCo scenes, drawn on a CPU in a few milliseconds.

MuJoCo draws shadows and reflections in passes of their own and every pixel several times, which a GPU hides and a CPU
does not. Without these, most of the time goes into meshes with thousands of faces, which can be hidden.
"""

from __future__ import annotations

import atexit
import importlib
import os
import weakref
from collections.abc import Sequence
from ctypes.util import find_library
from dataclasses import dataclass

import mujoco
import numpy as np

os.environ.setdefault("LP_NUM_THREADS", "0")  # Mesa's threads cost more than they gain in small frames

FLAGS = "SHADOW", "REFLECTION", "SKYBOX", "HAZE", "FOG"  # drawn in passes of their own
BACKENDS = "egl", "osmesa"
UNUSED: list[tuple] = []  # canvases and contexts of renderers that are gone
FACES = 2000  # of a mesh, from which on it is heavy


@dataclass(frozen=True)
class Camera:
    """Free camera.

    Attributes:
        name: name of the camera, and of its column in datasets.
        lookat: point in the middle of the frame (m).
        distance: distance from this point (m).
        azimuth: direction of view about the vertical (degrees): 0 is along x, 90 along y.
        elevation: direction of view above the horizontal (degrees): -90 looks straight down.
    """

    name: str
    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float

    def make(self) -> mujoco.MjvCamera:
        """Return MuJoCo's camera."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self.lookat
        camera.distance, camera.azimuth, camera.elevation = self.distance, self.azimuth, self.elevation
        return camera


class FrameRenderer:
    """Renderer of one model, without a display.

    ``mujoco.Renderer`` draws with the backend that was chosen when MuJoCo was first imported, which TorchRL does.

    Args:
        model: the model; its quality of shadows, and the visibility of hidden geoms, are changed.
        cameras: cameras, whose frames stand side by side.
        size: side of a frame in pixels.
        hide: numbers of the geoms that are not drawn.

    Raises:
        OSError: there is no library that draws without a display.
    """

    def __init__(self, model: mujoco.MjModel, cameras: Sequence[Camera], size: int, hide: Sequence[int] = ()):
        model.vis.quality.shadowsize = model.vis.quality.offsamples = 0
        model.geom_rgba[list(hide), 3] = 0
        self.model, self.cameras = model, [camera.make() for camera in cameras]
        free_unused()
        self.canvas = make_canvas(size)
        self.canvas.make_current()
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        # The garbage collector may come while another renderer draws, whose context must stay the current one.
        finalizer = weakref.finalize(self, UNUSED.append, (self.canvas, self.context))
        finalizer.atexit = False
        atexit.register(free_unused)
        atexit.register(finalizer)  # later than MuJoCo's own, and therefore called before
        drawn = 2 * (model.ngeom + model.nsite + model.ntendon)  # beyond maxgeom, MuJoCo leaves geoms out
        self.scene = mujoco.MjvScene(model, maxgeom=max(1000, drawn))
        self.option = mujoco.MjvOption()
        for flag in FLAGS:
            self.scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}")] = 0
        self.rectangle, self.frame = mujoco.MjrRect(0, 0, size, size), np.empty((size, size, 3), np.uint8)

    def __reduce__(self):
        raise TypeError("an environment that has drawn cannot be copied or pickled; make another one")

    def draw(self, data: mujoco.MjData) -> np.ndarray:
        """Draw the state of the model, uint8 ``[size, cameras * size, 3]``."""
        free_unused()
        self.canvas.make_current()
        frames = []
        for camera in self.cameras:
            everything = mujoco.mjtCatBit.mjCAT_ALL.value
            mujoco.mjv_updateScene(self.model, data, self.option, None, camera, everything, self.scene)
            mujoco.mjr_render(self.rectangle, self.scene, self.context)
            mujoco.mjr_readPixels(self.frame, None, self.rectangle, self.context)
            frames.append(self.frame[::-1].copy())  # OpenGL's first row is the lowest
        return np.concatenate(frames, 1)


def free_unused() -> None:
    """Free the memory of renderers that are no longer used."""
    while UNUSED:
        canvas, context = UNUSED.pop()
        canvas.make_current()
        context.free()
        canvas.free()


def make_canvas(size: int):
    """Return an OpenGL context of ``size`` x ``size`` pixels that needs no display.

    The environment variable ``MUJOCO_GL`` chooses ``egl`` or ``osmesa``; otherwise it is EGL where its library is. Only one
    of them can be loaded in a process.

    Raises:
        OSError: it does not work.
    """
    backend = os.environ.get("MUJOCO_GL", "").lower()
    if backend not in BACKENDS:
        backend = BACKENDS[0] if find_library("EGL") else BACKENDS[1]
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext(size, size)
    except Exception as error:  # every backend raises its own kinds
        raise OSError(
            f"MuJoCo cannot draw without a display here ({backend}: {error}); install the Debian packages libegl1 and "
            "libgl1-mesa-dri, or install libosmesa6 and set MUJOCO_GL=osmesa"
        ) from error


def find_heavy(model: mujoco.MjModel, keep: Sequence[str] = ()) -> list[int]:
    """Return the geoms with heavy meshes.

    Args:
        model: the model.
        keep: names of bodies whose geoms, and those of all that is attached to them, are left out.
    """
    meshes = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH)
    heavy = meshes[model.mesh_facenum[model.geom_dataid[meshes]] > FACES]
    kept = find_parts(model, keep)
    return [geom for geom in heavy.tolist() if model.geom_bodyid[geom] not in kept]


def find_parts(model: mujoco.MjModel, names: Sequence[str]) -> set[int]:
    """Return the numbers of the bodies of some names, and of all bodies that are attached to them.

    Raises:
        ValueError: the model has no body of a name.
    """
    numbers = {model.body(number).name: number for number in range(model.nbody)}
    if missing := [name for name in names if name not in numbers]:
        raise ValueError(f"the model must have the bodies {missing}, got the bodies {list(numbers)}")
    parts = {numbers[name] for name in names}
    for body, parent in enumerate(model.body_parentid.tolist()):  # a parent comes before its parts
        if parent in parts and body:
            parts.add(body)
    return parts
