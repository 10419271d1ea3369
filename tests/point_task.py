"""A task of one's own in a simulator of a few lines: a point that goes to a goal in the plane."""

from types import SimpleNamespace

import numpy as np

from dynmap_rl.envs.protocol import BaseTask, Layout

LIMIT = 0.1  # m


class Point(BaseTask):
    """A point that an action moves."""

    name, description, state_size = "point", "Go to the goal.", 4
    layout = Layout(
        10, 20, ("x", "y"), (LIMIT, LIMIT), ("x", "y", "goal_x", "goal_y"), ("x", "y"), ("x", "y")
    )

    def begin(self, seed, ranges=None, world=None):
        position, goal = np.random.default_rng(seed).random((2, 2))
        still = {"velocity": np.zeros(2), "acceleration": np.zeros(2), "steps": 0}
        events = {
            "position_error": float(np.linalg.norm(goal - position)),
            "dropped": False,
            "touched": set(),
        }
        return SimpleNamespace(position=position, goal=goal, **still, **events)

    def step(self, worlds, actions):
        for world, action in zip(worlds, actions, strict=True):
            world.position = world.position + action
            world.position_error = float(np.linalg.norm(world.goal - world.position))
            world.steps += 1

    def make_renderer(self):
        return lambda world: np.zeros((64, 64, 3), np.uint8)

    def agent_pos(self, world):
        return np.concatenate([world.position, world.goal])

    def state(self, world):
        return self.agent_pos(world).astype(np.float32)

    def reward(self, world):
        return 0.0

    def is_success(self, world):
        return world.steps >= 10 and world.position_error < 0.05
