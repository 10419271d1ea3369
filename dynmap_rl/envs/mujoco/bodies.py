"""Dynamics of named bodies in three dimensions.

The orientation of a body is a part of its rotation matrix, which is continuous: Euler angles jump, and a quaternion and
its negative are the same orientation. The first two columns determine the matrix (Zhou et al. 2019, "On the Continuity
of Rotation Representations in Neural Networks"). Of a body with an axis of symmetry, a frame shows the axis only, and of
a ball nothing. A world model cannot predict more than frames show, so that such bodies have fewer entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

ORIENTATIONS = {"full": ("xaxis", "yaxis"), "axis": ("zaxis",), "none": ()}
AXES = "xyz"


@dataclass(frozen=True)
class Body:
    """Body whose dynamics are recorded.

    Attributes:
        name: name in the columns of datasets.
        place: name of the body in the model or, where the body has no name, of one of its geoms or sites. The point
            and the axes are those of what is named; by default ``name``.
        orientation: ``full``: the x and the y axis of the body in the world, and the angular velocity. ``axis``: the z
            axis, for bodies that are symmetric about it, and the angular velocity without the part about that axis.
            ``none``: neither, for balls, and for what does not turn. The angular velocity of a body that lies on another
            one may be noise of the contacts; look at it before you train on it.
    """

    name: str
    place: str = ""
    orientation: str = "full"

    def __post_init__(self):
        if self.orientation not in ORIENTATIONS:
            kinds = ", ".join(ORIENTATIONS)
            raise ValueError(f"orientation of a body must be one of {kinds}, got {self.orientation!r}")

    @property
    def position_names(self) -> tuple[str, ...]:
        """Names of the entries of the position: the point (m), then the axes."""
        names = ["", *(f"{axis}_" for axis in ORIENTATIONS[self.orientation])]
        return tuple(f"{self.name}_{part}{axis}" for part in names for axis in AXES)

    @property
    def velocity_names(self) -> tuple[str, ...]:
        """Names of the entries of the velocity: linear (m/s), then angular (rad/s)."""
        names = [""] if self.orientation == "none" else ["", "omega_"]
        return tuple(f"{self.name}_{part}{axis}" for part in names for axis in AXES)


class BodyReader:
    """Reader of the dynamics of bodies.

    Args:
        model: MuJoCo's model.
        bodies: what to read, in this order.

    Raises:
        ValueError: the model has no body, geom or site of a name, or it is on a mocap body, which has no velocity.
    """

    def __init__(self, model: mujoco.MjModel, bodies: Sequence[Body]):
        self.model = model
        self.bodies = [(body.orientation, *_find(model, body.place or body.name)) for body in bodies]
        for body, (_, kind, number) in zip(bodies, self.bodies, strict=True):
            if model.body_mocapid[model.body_rootid[BODIES[kind](model, number)]] >= 0:
                raise ValueError(
                    f"{body.name} is on a mocap body, whose velocity MuJoCo does not know; name the body that is welded "
                    "to it"
                )
        self.six = np.empty(6)

    def read(self, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions ``[P]`` and velocities ``[V]`` of all bodies, float64 in SI units.

        Poses are brought up to date first: after ``mj_step`` they are those before its last substep.
        """
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(self.model, data)
        position, velocity = [], []
        for orientation, kind, number in self.bodies:
            point, matrix = POSES[kind](data, number)
            mujoco.mj_objectVelocity(self.model, data, kind, number, self.six, 0)
            position.append(point)
            velocity.append(self.six[3:].copy())
            if orientation == "full":
                position += [matrix[0::3], matrix[1::3]]
                velocity.append(self.six[:3].copy())
            elif orientation == "axis":
                axis = matrix[2::3]
                position.append(axis)
                velocity.append(self.six[:3] - (self.six[:3] @ axis) * axis)
        return np.concatenate(position), np.concatenate(velocity)


POSES = {  # XBODY is a body's own frame; BODY would be the frame of its centre of mass
    mujoco.mjtObj.mjOBJ_XBODY: lambda data, i: (data.xpos[i], data.xmat[i]),
    mujoco.mjtObj.mjOBJ_GEOM: lambda data, i: (data.geom_xpos[i], data.geom_xmat[i]),
    mujoco.mjtObj.mjOBJ_SITE: lambda data, i: (data.site_xpos[i], data.site_xmat[i]),
}

BODIES = {  # number of the body that each is on
    mujoco.mjtObj.mjOBJ_XBODY: lambda model, i: i,
    mujoco.mjtObj.mjOBJ_GEOM: lambda model, i: model.geom_bodyid[i],
    mujoco.mjtObj.mjOBJ_SITE: lambda model, i: model.site_bodyid[i],
}


def _find(model: mujoco.MjModel, name: str) -> tuple[mujoco.mjtObj, int]:
    """Return kind and number of the body, geom or site of a name."""
    for kind in POSES:
        if (number := mujoco.mj_name2id(model, kind, name)) >= 0:
            return kind, number
    named = [model.body(i).name for i in range(model.nbody)]
    raise ValueError(f"the model must have a body, geom or site {name!r}, got the bodies {named}")
