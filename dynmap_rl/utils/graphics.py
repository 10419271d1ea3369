"""Check of the renderer that ``MUJOCO_GL`` names."""

from __future__ import annotations

import importlib
import os
from importlib.util import find_spec


def check_mujoco_gl() -> None:
    """Check that MuJoCo can be imported with the renderer that the environment variable ``MUJOCO_GL`` names.

    MuJoCo loads the renderer's library when it is imported, and TorchRL imports MuJoCo even for tasks without it.

    Raises:
        OSError: it cannot.
    """
    renderer = os.environ.get("MUJOCO_GL")
    if not renderer or find_spec("mujoco") is None:
        return
    try:
        importlib.import_module("mujoco")
    except Exception as error:  # every renderer raises its own kinds
        raise OSError(
            f"MUJOCO_GL must be a renderer that can be loaded here, got {renderer} ({' '.join(str(error).split())}); "
            "install the Debian package libegl1 for egl or libosmesa6 for osmesa, or unset MUJOCO_GL"
        ) from error
