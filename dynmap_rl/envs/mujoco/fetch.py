"""Two tasks of gymnasium-robotics (Plappert et al. 2018) without grasping: a box that is pushed, a puck that slides."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np

from .bodies import Body
from .fetch_experts import PushExpert, SlideExpert
from .rendering import Camera
from .task import MujocoTask, MujocoWorld

LOST = 0.35  # m, height below which an object has fallen off the table


class FetchTask(MujocoTask):
    """Task of a Fetch arm at a table.

    Action, within -1 to 1: x, y and z of the hand's target, 50 mm a step each, and the gripper, which is blocked.

    Success: in the last step, the object is within 50 mm of the goal, a red dot. Starts that are solved already are
    left out.

    Attributes:
        environment: Gymnasium id.
    """

    environment: str
    steps = 50
    fps = 25
    hide = ("robot0:mocap",)
    robot = "fetch"

    def make(self) -> gymnasium.Env:
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(self.environment).unwrapped  # its time limit is that of the task

    def prepare(self, world: MujocoWorld) -> None:
        world.env._render_callback()  # moves the goal's marker

    def goal(self, world: MujocoWorld) -> np.ndarray:
        return world.env.goal

    def is_solved(self, world: MujocoWorld) -> bool:
        return self.distance(world) < world.env.distance_threshold

    def is_dropped(self, world: MujocoWorld) -> bool:
        return bool(world.position[2] < LOST)


class FetchPush(FetchTask):
    """Push a box over a table to a goal."""

    name = "fetch_push"
    description = "Push the black box to the red dot."
    environment = "FetchPush-v4"
    bodies = (Body("box", "object0"), Body("hand", "robot0:grip", "none"))
    views = (
        Camera("front", (1.36, 0.75, 0.42), 0.75, 180, -55),
        Camera("side", (1.32, 0.75, 0.42), 0.75, 90, -40),
    )

    def demonstrator(self, world: MujocoWorld) -> Callable[[], np.ndarray]:
        return PushExpert(world, self.goal(world))


class FetchSlide(FetchTask):
    """Bring a puck to rest at a goal, which is often beyond the arm's reach, so that the puck must slide there.

    The puck has no orientation in the columns: it lies flat, and its contacts make MuJoCo's angular velocity jump between
    -3 and 3 rad/s while it rests.
    """

    name = "fetch_slide"
    description = "Slide the black puck so that it comes to rest at the red dot."
    environment = "FetchSlide-v4"
    bodies = (Body("puck", "object0", "none"), Body("hand", "robot0:grip", "none"))
    views = (
        Camera("front", (1.26, 0.75, 0.42), 1.2, 180, -65),
        Camera("side", (1.3, 0.75, 0.42), 1.2, 90, -50),
    )

    def demonstrator(self, world: MujocoWorld) -> Callable[[], np.ndarray]:
        return SlideExpert(world, self.goal(world))
