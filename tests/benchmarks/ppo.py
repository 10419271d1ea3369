"""PPO on states: wall time until 97 % of 200 fresh scenes succeed, with evaluations left out of the time."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import dynmap_rl  # noqa: F401  (registers the ids)
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.envs.world import ACCELERATION_LIMIT, EPISODE_STEPS
from dynmap_rl.training.settings import PPOTraining

GOAL = 0.97
ACCELERATION = 0.25  # share of the limits, as in the recipe
LIMIT = (ACCELERATION * ACCELERATION_LIMIT).astype(np.float32)
EXPERT = Path(__file__).parents[2] / "recipes" / "expert.py"


def ours(seed: int, settings: PPOTraining, episodes: int, threads: int = 2) -> float:
    """Run ``recipes/expert.py``, which writes its seconds and success rates, and stop it at the goal."""
    with tempfile.TemporaryDirectory() as folder:
        sizes = {
            "ppo.seed": seed, "threads": threads, "ppo.iterations": settings.iterations,
            "ppo.num_envs": settings.num_envs, "acceleration": ACCELERATION, "ppo.checkpoint_every": 1, "ppo.eval_episodes": episodes, "ppo.final_episodes": episodes,
        }  # fmt: skip
        command = [sys.executable, str(EXPERT), "--run", folder]
        command += [f"--{name}={size}" for name, size in sizes.items()]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            reached = math.inf
            while math.isinf(reached) and process.poll() is None:
                time.sleep(0.5)
                reached = _reached(folder)
            process.kill()
        if process.returncode > 0:
            raise subprocess.CalledProcessError(process.returncode, command)
        return _reached(folder)


def _reached(folder: str) -> float:
    facts = [json.loads(path.read_text()) for path in sorted(Path(folder).glob("checkpoint/*.json"))]
    return next((f["seconds"] for f in facts if f["success"] >= GOAL), math.inf)


def stable_baselines(seed: int, settings: PPOTraining, episodes: int, threads: int = 2) -> float:
    """Run Stable-Baselines3's PPO on the Gymnasium id, with the same settings, limits and threads."""
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    torch.set_num_threads(threads)
    task = get_task("balance_reaching")

    class Watch(BaseCallback):
        """Callback that stops at the goal; ``spent`` is the time without evaluations."""

        spent = 0.0
        reached = math.inf

        def _on_training_start(self) -> None:
            self.began = time.perf_counter()

        def _on_rollout_start(self) -> None:  # after every update
            self.spent += time.perf_counter() - self.began
            if self.num_timesteps and success(self.model) >= GOAL:
                self.reached = min(self.reached, self.spent)
            self.began = time.perf_counter()

        def _on_step(self) -> bool:
            return math.isinf(self.reached)

    def success(model) -> float:
        rngs = [np.random.default_rng(scene_seed("exploration", 10_000_000 + i)) for i in range(episodes)]
        worlds = [task.make_world(task.sample_scene(rng)) for rng in rngs]
        for _ in range(EPISODE_STEPS):
            action, _ = model.predict(np.stack([task.state(w) for w in worlds]), deterministic=True)
            for world, a in zip(worlds, action, strict=True):
                world.accelerate(a * LIMIT)
        return sum(task.is_success(world) for world in worlds) / len(worlds)

    def make():
        env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="state", control="acceleration")
        space = gym.spaces.Box(-1, 1, env.action_space.shape)
        return gym.wrappers.TransformAction(env, lambda a: a * LIMIT, space)

    model = PPO(
        "MlpPolicy",
        make_vec_env(make, settings.num_envs, seed=seed),
        learning_rate=lambda left: settings.learning_rate * (0.1 + 0.9 * left),
        n_steps=settings.steps,
        batch_size=settings.minibatch,
        n_epochs=settings.epochs,
        gamma=settings.gamma,
        gae_lambda=settings.gae_lambda,
        clip_range=settings.clip,
        ent_coef=settings.entropy,
        vf_coef=1.0,
        policy_kwargs={"net_arch": [128, 128], "activation_fn": torch.nn.Tanh, "log_std_init": -1.2},
        seed=seed,
        device="cpu",
    )
    watch = Watch()
    model.learn(settings.iterations * settings.num_envs * settings.steps, callback=watch)
    return watch.reached


def ppo(seeds=(0, 1, 2), episodes: int = 200, **sizes: int) -> dict:
    """Return the seconds to the goal, the median over seeds; infinite where the frames were not enough.

    Args:
        seeds: one pair of runs each.
        episodes: scenes on which every iteration is judged.
        sizes: settings that differ from the recipe's.
    """
    settings = PPOTraining(**sizes)
    pairs = [(ours(seed, settings, episodes), stable_baselines(seed, settings, episodes)) for seed in seeds]
    a, b = (float(np.median(times)) for times in zip(*pairs, strict=True))
    return {"ours": a, "theirs": b, "ratio": a / b, "pairs": pairs}
