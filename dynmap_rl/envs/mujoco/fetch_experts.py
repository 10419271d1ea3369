"""Experts of the Fetch tasks: controllers that read the state of the simulator."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .task import MujocoWorld

REST, RISE = np.zeros(4, np.float32), np.array([0, 0, 1, 0], np.float32)


def steer(world: MujocoWorld, x: float, y: float, z: float, gain: float = 12.0) -> np.ndarray:
    """Return the action ``[4]`` that moves the hand to a point (m); the last body is the hand."""
    return np.append(gain * (np.array([x, y, z]) - world.position[-3:]), 0.0).clip(-1, 1)


def hover_behind(world: MujocoWorld, way: np.ndarray, distance: float, height: float) -> np.ndarray:
    """Return the action that brings the hand to the table behind the object, from above unless it is there already.

    Args:
        world: world with the object first and the hand last.
        way: direction from the object to the goal, ``[2]``, of length 1.
        distance: distance behind the object (m).
        height: height of the hand on the table (m).
    """
    x, y = world.position[:2] - distance * way
    off = np.hypot(x - world.position[-3], y - world.position[-2])
    near = np.linalg.norm(world.position[-3:-1] - world.position[:2]) < distance + 0.05
    if off > 0.03 and near and world.position[-1] < height + 0.03:
        x, y = world.position[-3:-1]  # straight up, so as not to touch the object
    return steer(world, x, y, height if off < 0.02 else height + 0.07)


class PushExpert:
    """Controller that goes behind the box, pushes it along the line to the goal, corrects sideways, and stops there.

    Args:
        world: world of :class:`FetchPush`.
        goal: ``[3]`` (m).
    """

    HEIGHT = 0.425  # m, of the hand while it pushes
    BEHIND = 0.07  # m, from the box to the hand before the push

    def __init__(self, world: MujocoWorld, goal: np.ndarray):
        self.world, self.goal = world, goal

    def __call__(self) -> np.ndarray:
        """Return the next action ``[4]``."""
        box, hand = self.world.position[:3], self.world.position[-3:]
        way = (self.goal - box)[:2]
        left = np.linalg.norm(way)
        if left < 0.012:
            return REST
        way /= left
        along = (hand - box)[:2] @ way
        side = (hand - box)[:2] - along * way
        low = hand[2] < self.HEIGHT + 0.03
        if low and np.linalg.norm(side) < 0.02 and -self.BEHIND - 0.04 < along < -0.02:
            speed = min(0.6, 0.05 + 6 * left)
            return np.append(speed * way - 12 * side, [10 * (self.HEIGHT - hand[2]), 0]).clip(-1, 1)
        return hover_behind(self.world, way, self.BEHIND, self.HEIGHT)


class SlideExpert:
    """Controller that presses the hand onto the puck, moves both, and launches the puck if the goal is out of reach.

    A goal within reach is where the hand brings the puck, and stays. Otherwise it brings the puck in line with the goal,
    goes behind it, touches it softly, and launches it straight ahead. How far the puck slides then follows from the
    action, and hardly from where exactly the hand was, which frames of 64 pixels do not show.

    Args:
        world: world of :class:`FetchSlide`.
        goal: ``[3]`` (m).
    """

    REACH = 1.4  # m, x of goals to which the hand brings the puck
    LAUNCH = 1.18  # m, x from where the puck is launched to others
    ABOVE, PRESSED, BEHIND = 0.467, 0.431, 0.42  # m, heights of the hand over, on and behind the puck
    GAP = 0.058  # m, from the hand behind the puck to its middle
    LEAD = 0.1  # s, by which the hand is ahead of a puck that still moves sideways
    TOUCH, LAUNCH_STEPS = 4, 2  # steps
    CHANGE = 0.25  # of the action from step to step, with which the puck does not slip
    SLOW = 0.12  # m/s, of a puck that is let go

    def __init__(self, world: MujocoWorld, goal: np.ndarray):
        self.world, self.goal, self.actions = world, goal[:2].copy(), self._plan()

    def __call__(self) -> np.ndarray:
        """Return the next action ``[4]``."""
        return next(self.actions, REST)

    @property
    def puck(self) -> np.ndarray:
        return self.world.position[:2]

    @property
    def hand(self) -> np.ndarray:
        return self.world.position[-3:]

    def _plan(self) -> Iterator[np.ndarray]:
        yield from self._press()
        if self.goal[0] < self.REACH:
            yield from self._bring(self.goal, 30)
        else:
            yield from self._bring(np.array([self.LAUNCH, self.goal[1]]), 12, 0.015)
            yield from self._go_behind()
            for _ in range(self.TOUCH):
                yield np.append(0.25, self._steer_behind(0, self.BEHIND)[1:])
            yield from [np.array([self._find_launch(), 0, 0, 0])] * self.LAUNCH_STEPS

    def _press(self) -> Iterator[np.ndarray]:
        """Go over the puck, and down onto it."""
        while np.linalg.norm(self.puck - self.hand[:2]) > 0.008:
            beside = self.hand[2] < self.ABOVE - 0.01 and np.linalg.norm(self.puck - self.hand[:2]) < 0.075
            yield RISE if beside else steer(self.world, *self.puck, self.ABOVE, gain=20)
        while self.hand[2] > self.PRESSED + 0.006:
            yield steer(self.world, *self.puck, self.PRESSED - 0.001, gain=20)

    def _bring(self, place: np.ndarray, gain: float, tolerance: float = 0) -> Iterator[np.ndarray]:
        """Move the hand and the puck under it to a place ``[2]`` (m); let the puck go there if there is a tolerance (m)."""
        action = np.zeros(2)
        while (
            np.linalg.norm(way := place - self.puck) > tolerance
            or np.linalg.norm(self.world.velocity[:2]) > self.SLOW
        ):
            change = gain * way / max(1, gain * np.abs(way).max()) - action
            action = action + change * min(1, self.CHANGE / max(np.linalg.norm(change), 1e-9))
            yield np.append(action, [20 * (self.PRESSED - self.hand[2]), 0]).clip(-1, 1)
        while self.hand[2] < self.ABOVE - 0.005:
            yield RISE

    def _go_behind(self) -> Iterator[np.ndarray]:
        """Go behind the puck and down."""
        while self.hand[0] > self.puck[0] - self.GAP + 0.006:
            yield self._steer_behind(self.GAP + 0.006, self.ABOVE)
        while self.hand[2] > self.BEHIND + 0.008:
            yield self._steer_behind(self.GAP, self.BEHIND)

    def _steer_behind(self, distance: float, height: float) -> np.ndarray:
        x, y = self.puck - (distance, 0) + (0, self.LEAD * self.world.velocity[1])
        return steer(self.world, x, y, height, gain=20)

    def _find_launch(self) -> float:
        """Return the action in x that launches the puck to the goal: the inverse of a parabola, fitted to 200 launches."""
        far = self.goal[0] - 1.185
        return float(np.clip((np.sqrt(0.15**2 + 4 * 0.31 * far) - 0.15) / (2 * 0.31), 0, 1))
