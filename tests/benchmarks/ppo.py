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

GOAL = 0.97
EXPERT = Path(__file__).parents[2] / "recipes" / "expert.py"


def ours(seed: int, iterations: int, num_envs: int, episodes: int, threads: int = 2) -> float:
    """Run ``recipes/expert.py``, which writes its seconds and success rates, and stop it at the goal."""
    with tempfile.TemporaryDirectory() as folder:
        sizes = {
            "ppo.seed": seed, "threads": threads, "ppo.iterations": iterations, "ppo.num_envs": num_envs,
            "ppo.checkpoint_every": 1, "ppo.eval_episodes": episodes, "ppo.final_episodes": episodes,
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


def stable_baselines(seed: int, iterations: int, num_envs: int, episodes: int, threads: int = 2) -> float:
    """Run Stable-Baselines3's PPO on the Gymnasium id, with the same settings and threads."""
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
                world.accelerate(a * ACCELERATION_LIMIT)
        return sum(task.is_success(world) for world in worlds) / len(worlds)

    def make():
        env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="state", control="acceleration")
        return gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))

    model = PPO(
        "MlpPolicy",
        make_vec_env(make, num_envs, seed=seed),
        learning_rate=lambda left: 5e-4 * (0.1 + 0.9 * left),
        n_steps=EPISODE_STEPS,
        batch_size=1024,
        n_epochs=10,
        gamma=0.97,
        gae_lambda=0.95,
        clip_range=0.2,
        ent_coef=1e-3,
        vf_coef=1.0,
        policy_kwargs={"net_arch": [128, 128], "activation_fn": torch.nn.Tanh, "log_std_init": -0.7},
        seed=seed,
        device="cpu",
    )
    watch = Watch()
    model.learn(iterations * num_envs * EPISODE_STEPS, callback=watch)
    return watch.reached


def ppo(seeds=(0, 1, 2), iterations: int = 45, num_envs: int = 64, episodes: int = 200) -> dict:
    """Return the seconds to the goal, the median over seeds; infinite where the frames were not enough."""
    sizes = iterations, num_envs, episodes
    pairs = [(ours(seed, *sizes), stable_baselines(seed, *sizes)) for seed in seeds]
    a, b = (float(np.median(times)) for times in zip(*pairs, strict=True))
    return {"ours": a, "theirs": b, "ratio": a / b, "pairs": pairs}
