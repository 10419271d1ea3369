"""One episode of a Gymnasium environment with MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np

from .bodies import Body, BodyReader
from .rendering import FrameRenderer

UNSTABLE = [getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}").value for name in ("QPOS", "QVEL", "QACC")]


class MujocoWorld:
    """One episode of a Gymnasium environment (see :class:`dynmap_rl.envs.protocol.SimulatedWorld`).

    Args:
        env: environment whose ``unwrapped`` has ``model`` and ``data``.
        bodies: bodies whose dynamics are read.
        dt: duration of a step (s).

    Attributes:
        env, model, data: the environment, and MuJoCo's model and data.
        observation: last observation of the environment.
        info: last ``info`` of the environment.
        reward: last reward.
        solved: whether any step so far was a success.

    Raises:
        ValueError: the environment has no MuJoCo model, or lacks one of the bodies.
    """

    def __init__(self, env: gymnasium.Env, bodies: Sequence[Body], dt: float):
        self.env, self.bodies, self.dt, self.model, self.data = env, bodies, dt, None, None
        if not (hasattr(env.unwrapped, "model") and hasattr(env.unwrapped, "data")):
            raise ValueError(f"{env.unwrapped!r} must have MuJoCo's model and data")
        self.attach()

    def attach(self) -> None:
        """Read and draw the environment's present model and data, which a reset may have replaced."""
        inner = self.env.unwrapped
        if inner.model is not self.model or inner.data is not self.data:
            self.model, self.data = inner.model, inner.data
            self.reader = BodyReader(self.model, self.bodies)
            self.renderer: FrameRenderer | None = None

    def check_places(self) -> None:
        """Check that everything is drawn where the model has it, relative to its body.

        Raises:
            ValueError: a site or geom is not.
        """
        for kind, objects in (("site", mujoco.mjtObj.mjOBJ_SITE), ("geom", mujoco.mjtObj.mjOBJ_GEOM)):
            body = getattr(self.model, f"{kind}_bodyid")
            turn = self.data.xmat[body].reshape(-1, 3, 3)
            place = self.data.xpos[body] + (turn @ getattr(self.model, f"{kind}_pos")[..., None])[..., 0]
            gap = np.abs(place - getattr(self.data, f"{kind}_xpos")).max(1, initial=0)
            for i in np.flatnonzero(gap > 1e-6):
                name = mujoco.mj_id2name(self.model, objects, i)
                raise ValueError(
                    f"the {kind} {name!r} has been moved but is drawn {1000 * gap[i]:.0f} mm away; call mj_forward in prepare, "
                    f"and give the {kind} a pos in the XML, as MuJoCo ignores later ones of what is compiled at the origin of "
                    "its body"
                )

    def begin(self, observation: Any, info: dict) -> None:
        """Forget the last episode, after a reset of the environment."""
        self.observation, self.info, self.reward = observation, info, 0.0
        self.steps, self.solved, self.dropped, self.touched = 0, False, False, set()
        self.position, self.velocity = self.reader.read(self.data)
        self.acceleration = np.zeros_like(self.velocity)
        self.data.warning.number[UNSTABLE] = 0

    def step(self, action: np.ndarray) -> None:
        """Simulate one control step.

        Raises:
            ValueError: the step does not last ``dt``, as where the environment resets itself, or the simulation is unstable.
        """
        time, before = self.data.time, self.velocity
        self.observation, reward, _, _, self.info = self.env.step(action)
        self.reward, self.steps = float(reward), self.steps + 1
        if not np.isfinite(self.reward):
            raise ValueError(f"the environment's reward must be finite, got {reward} in step {self.steps}")
        self.position, self.velocity = self.reader.read(self.data)
        finite = np.isfinite(self.position).all() and np.isfinite(self.velocity).all()
        if not finite or self.data.warning.number[UNSTABLE].any():  # MuJoCo may have reset its data meanwhile
            raise ValueError(
                f"the simulation is unstable in step {self.steps}: MuJoCo found numbers that are huge or not finite"
            )
        if (elapsed := self.data.time - time) <= 0:
            raise ValueError(
                f"the environment resets itself in step {self.steps}; leave out its own limit of steps, and Autoreset"
            )
        if not np.isclose(elapsed, self.dt):
            raise ValueError(f"fps must be {1 / elapsed:g}, the environment's, got {1 / self.dt:g}")
        # MuJoCo's own accelerations are those of an instant, with spikes at contacts.
        self.acceleration = (self.velocity - before) / self.dt
