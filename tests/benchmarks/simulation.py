"""The simulator: a control step, a frame, the batched environment, several processes."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from timing import compare, seconds
from torchrl.envs.utils import step_mdp

import dynmap_rl  # noqa: F401  (registers the ids)
from dynmap_rl.envs.renderer import Renderer
from dynmap_rl.envs.scene import sample_scene
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.envs.world import CONTROL_DT, EPISODE_STEPS, SUBSTEPS, World

TASK = get_task("balance_reaching")


def make_world(seed: int = 0) -> World:
    return World(sample_scene(np.random.default_rng(seed)))


def smooth_actions(seed: int = 0, steps: int = EPISODE_STEPS) -> np.ndarray:
    """To and fro at a tenth of the limits, so that the block stays on the cart: contacts in every substep."""
    phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, 3)
    time = np.arange(steps)[:, None] * CONTROL_DT
    return 0.002 * np.sin(2 * time + phase) * np.sin(time)


def control_step() -> dict:
    """A control step against a bare Python loop of 50 x (set the cart's velocity, ``space.step``)."""
    actions = smooth_actions()

    def ours():
        world = make_world()
        return seconds(lambda: [world.step(action) for action in actions]) / len(actions)

    def bare():
        world = make_world()
        cart, step, dt = world.cart, world.space.step, CONTROL_DT / SUBSTEPS
        velocities = (actions / CONTROL_DT).tolist()

        def run():
            for x, y, _ in velocities:
                for _ in range(SUBSTEPS):
                    cart.velocity = (x, y)
                    step(dt)

        return seconds(run) / len(actions)

    return compare(ours, bare, repeats=25)


def frame() -> dict:
    """A control step with a 64 x 64 frame against one without."""
    actions, renderer = smooth_actions(), Renderer()

    def with_frame():
        world = make_world()

        def run():
            for action in actions:
                world.step(action)
                renderer.draw(world, TASK)

        return seconds(run) / len(actions)

    def without():
        world = make_world()
        return seconds(lambda: [world.step(action) for action in actions]) / len(actions)

    return compare(with_frame, without, repeats=25)


def pusht() -> dict | None:
    """Frames a second through the Gymnasium id with ``pixels``, against gym-pusht's, both at 64 x 64.

    gym-pusht needs PyMunk 6 and so an environment of its own: the variable ``PUSHT_PYTHON`` names its interpreter.
    """
    if "PUSHT_PYTHON" not in os.environ:
        return None
    env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels")
    actions = smooth_actions().astype(np.float32)

    def ours():
        env.reset(seed=0)
        return len(actions) / seconds(lambda: [env.step(action) for action in actions])

    def theirs():
        script = Path(__file__).with_name("pusht.py")
        return float(subprocess.check_output([os.environ["PUSHT_PYTHON"], script], stderr=subprocess.DEVNULL))

    return compare(ours, theirs, repeats=5)


def batch(num_envs: int = 64, steps: int = 60) -> dict:
    """The batched TorchRL environment against its worlds alone, on one core, a control step of all of them."""
    torch.set_num_threads(1)
    actions = np.stack([smooth_actions(i, steps) for i in range(num_envs)], 1).astype(np.float32)

    def ours():
        env = DynmapBatchedEnv(num_envs=num_envs, seed=0)
        td, tensors = env.reset(scene_seed=torch.arange(num_envs)), torch.from_numpy(actions)

        def run():
            state = td
            for action in tensors:
                state = step_mdp(env.step(state.set("action", action)))

        return seconds(run) / steps

    def worlds_alone():
        worlds = [make_world(i) for i in range(num_envs)]

        def run():
            for step in actions:
                for world, action in zip(worlds, step, strict=True):
                    world.step(action)

        return seconds(run) / steps

    return compare(ours, worlds_alone)


def processes(num_envs: int = 64, steps: int = 400, amount: int = 20_000_000) -> dict:
    """Control steps a second in two processes of 64 worlds, against one; ``limit`` is the same for plain arithmetic,
    which shares nothing: what this machine's second core gives."""

    def two_and_one(*work):
        return compare(lambda: _rate(2, *work), lambda: _rate(1, *work), repeats=3)

    return two_and_one(_step_worlds, num_envs, steps) | {"limit": two_and_one(_count, amount)["ratio"]}


def _rate(count: int, *work) -> float:
    context = multiprocessing.get_context("spawn")
    barrier, queue = context.Barrier(count), context.Queue()
    workers = [context.Process(target=_timed, args=(barrier, queue, *work)) for _ in range(count)]
    for worker in workers:
        worker.start()
    rates = [queue.get() for _ in workers]
    for worker in workers:
        worker.join()
    return sum(rates)


def _timed(barrier, queue, work, *sizes) -> None:
    torch.set_num_threads(1)
    run, amount = work(*sizes)
    barrier.wait()
    queue.put(amount / seconds(run))


def _step_worlds(num_envs: int, steps: int):
    env = DynmapBatchedEnv(num_envs=num_envs, seed=0)
    td = env.reset()
    actions = torch.from_numpy(np.stack([smooth_actions(i, steps) for i in range(num_envs)], 1)).float()

    def run():
        state = td
        for action in actions:
            state = step_mdp(env.step(state.set("action", action)))

    return run, num_envs * steps


def _count(amount: int):
    return lambda: sum(range(amount)), amount
