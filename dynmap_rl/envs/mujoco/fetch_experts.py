"""Experts of the Fetch tasks: a controller that pushes, and a strike that is found by trying it in the simulator."""

from __future__ import annotations

import gymnasium
import mujoco
import numpy as np

from .task import MujocoWorld

REACH = 0.05  # m, change of the hand's target in a step of action 1
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
REST = np.zeros(4, np.float32)


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


def advance(env: gymnasium.Env, action: np.ndarray) -> None:
    """Simulate a step of a Fetch environment without its observation, which takes a third of the time."""
    env._set_action(action)
    env._mujoco_step(action)
    env._step_callback()


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


class StrikeExpert:
    """Strike whose aim and speed are found by trying strikes from the saved state of the simulator.

    The hand goes behind the puck and runs along the line to the goal. Running beside the puck's middle turns the puck's
    way, by about 8 degrees for 10 mm. A trial ends when the puck has left the hand; where it will come to rest follows
    from its velocity. The best trial is then simulated to the end, and its error corrects the following trials.

    Args:
        world: world of :class:`FetchSlide`.
        goal: ``[3]`` (m).
        steps: control steps of an episode.
    """

    HEIGHT = 0.42  # m, of the hand
    BEHIND = 0.13  # m, from the puck to the hand before the strike
    RUN = 0.25  # m, way of the hand in a strike
    SIDEWAYS = 14.0  # rad/m, turn of the puck's way
    DECELERATION = 1.02  # m/s^2, of the puck on the table
    CREEP = 0.055  # m, further than a constant deceleration leads
    ROUNDS, TRIALS = 6, 8
    CLOSE, ENOUGH = 0.02, 0.035  # m, errors of a trial and of a whole episode with which the search ends
    LATEST = 20  # step of the strike at the latest

    def __init__(self, world: MujocoWorld, goal: np.ndarray, steps: int):
        self.world, self.goal, self.last = world, goal[:2].copy(), steps
        self.plan: list[np.ndarray] | None = None
        self.exact = False

    def __call__(self) -> np.ndarray:
        """Return the next action ``[4]``."""
        puck, hand = self.world.position[:2], self.world.position[-3:]
        if self.plan is None:
            way = (self.goal - puck) / np.linalg.norm(self.goal - puck)
            ready = (
                np.linalg.norm(puck - self.BEHIND * way - hand[:2]) < 0.012 and hand[2] < self.HEIGHT + 0.012
            )
            if not ready and self.world.steps < self.LATEST:
                return hover_behind(self.world, way, self.BEHIND, self.HEIGHT)
            self.plan, self.exact = self._search(puck.copy(), way)[::-1], True
        return self.plan.pop() if self.plan else REST

    def _search(self, puck: np.ndarray, way: np.ndarray) -> list[np.ndarray]:
        """Return the actions of the best strike found."""
        rng, state = np.random.default_rng(0), np.empty(mujoco.mj_stateSize(self.world.model, STATE))
        mujoco.mj_getState(self.world.model, self.world.data, state, STATE)
        far, bias, final = float(np.linalg.norm(self.goal - puck)), np.zeros(2), (np.inf, [])
        strike = float(np.clip(0.25 + far, 0.3, 1.2)), 0.0  # speed (1.25 m/s) and offset (m)
        for _ in range(self.ROUNDS):
            best = (np.inf,)
            for trial in range(self.TRIALS):
                actions = self._strike(way, *strike)
                rest = self._try(state, actions) + bias
                if (error := float(np.linalg.norm(rest - self.goal))) < best[0]:
                    best = error, strike, rest, actions
                if error < self.CLOSE:
                    break
                if trial < 4:
                    share = 1.0 if trial < 2 else rng.uniform(0.3, 1.2)
                    strike = self._improve(strike, rest - puck, way, far, share)
                else:  # around the best, at random: what a strike does is not quite smooth
                    strike = self._improve(best[1], best[2] - puck, way, far, rng.uniform(0.3, 1.2))
                    strike = tuple(np.array(strike) + (0.03, 0.003) * rng.standard_normal(2))
            _, strike, expected, actions = best
            rest = self._try(state, actions, to_the_end=True)
            if (error := float(np.linalg.norm(rest - self.goal))) < final[0]:
                final = error, actions
            if error < self.ENOUGH:
                break
            bias += rest - expected
            strike = self._improve(strike, rest - puck, way, far, 1.0)
        self._restore(state)
        return final[1]

    def _improve(
        self, strike: tuple[float, float], moved: np.ndarray, way: np.ndarray, far: float, share: float
    ) -> tuple[float, float]:
        """Return speed and offset, corrected by a share of the error of a strike.

        The range grows with the speed, and the puck's way turns with the offset.

        Args:
            strike: speed and offset.
            moved: how far the strike moved the puck, ``[2]`` (m).
            way: direction to the goal, ``[2]``.
            far: distance to the goal (m).
            share: 1 is the whole correction.
        """
        turn = np.arctan2(way[0] * moved[1] - way[1] * moved[0], way @ moved)
        faster = (far / max(float(np.linalg.norm(moved)), 0.05)) ** (0.6 * share)
        offset = np.clip(strike[1] + share * turn / self.SIDEWAYS, -0.04, 0.04)
        return float(np.clip(strike[0] * faster, 0.15, 1.3)), float(offset)

    def _strike(self, way: np.ndarray, speed: float, offset: float) -> list[np.ndarray]:
        """Return the actions that move the hand aside by ``offset`` (m), and then along ``way`` with ``speed``."""
        aside = np.append(offset * np.array([-way[1], way[0]]) / REACH, [0, 0])
        count = self.RUN / (REACH * speed)
        run = np.append(speed * way, [0, 0])
        actions = [aside, REST, REST, *[run] * int(count), run * (count % 1)]
        return [action.clip(-1, 1).astype(np.float32) for action in actions]

    def _try(self, state: np.ndarray, actions: list[np.ndarray], to_the_end: bool = False) -> np.ndarray:
        """Return where the puck comes to rest ``[2]``, simulated or foreseen."""
        self._restore(state)
        env, reader, data = self.world.env, self.world.reader, self.world.data
        steps = self.last - self.world.steps if to_the_end else len(actions) + 6
        for step in range(steps):
            advance(env, actions[step] if step < len(actions) else REST)
            position, velocity = reader.read(data)
            left = (
                np.linalg.norm(position[:2] - position[-3:-1]) > 0.06 and np.linalg.norm(velocity[:2]) > 0.1
            )
            if left and not to_the_end:
                break
        if to_the_end:
            return position[:2]
        speed = float(np.linalg.norm(velocity[:2]))
        return position[:2] + velocity[:2] * (speed / (2 * self.DECELERATION) + self.CREEP / max(speed, 1e-6))

    def _restore(self, state: np.ndarray) -> None:
        mujoco.mj_setState(self.world.model, self.world.data, state, STATE)
        mujoco.mj_forward(self.world.model, self.world.data)
