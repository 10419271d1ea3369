"""Frames a second of gym-pusht's ``pixels``; runs in an environment of its own, which has PyMunk 6."""

import time

import gym_pusht  # noqa: F401
import gymnasium as gym

env = gym.make("gym_pusht/PushT-v0", obs_type="pixels", observation_width=64, observation_height=64)
env.reset(seed=0)
env.action_space.seed(0)
actions = [env.action_space.sample() for _ in range(100)]
began = time.perf_counter()
for action in actions:
    env.step(action)
print(len(actions) / (time.perf_counter() - began))
