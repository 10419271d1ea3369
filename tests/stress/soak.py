"""Run one million control steps with frames, episode after episode, and check that the held memory does not grow.

    uv run python tests/stress/soak.py                  # minutes; writes recipes/results/measurements/soak.json
    uv run python tests/stress/soak.py --steps 30000

Random scenes of the three tasks take turns, with actions that change now and then, through the Gymnasium ids. After
every tenth of the steps, garbage is collected and the allocator returns its free memory, so that something holds what
remains. The script fails where that is at the end more than 2 MB above its value after the first tenth.
"""

import argparse
import ctypes
import gc
import resource
import sys
import time
from pathlib import Path

import gymnasium
import numpy as np

import dynmap_rl  # noqa: F401 (the ids)
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

IDS = "dynmap_rl/BalanceReaching-v1", "dynmap_rl/BalanceReachingObstacle-v1", "dynmap_rl/BinDropping-v1"
RESULTS = Path(__file__).parents[2] / "recipes/results/measurements/soak.json"
GROWTH_MB = 2.0


def soak(steps: int) -> dict:
    """Return the memory (MB) after every tenth of the steps, with and without garbage, and the number of episodes."""
    envs = [gymnasium.make(name, obs_type="pixels_agent_pos") for name in IDS]
    rng, resident, held, episodes, over, action = np.random.default_rng(0), [], [], 0, True, None
    for step in range(1, steps + 1):
        if over:
            env = envs[episodes % len(envs)]
            env.reset(seed=episodes)
            episodes += 1
        if over or step % 15 == 0:
            action = rng.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        _, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        if step % (steps // 10) == 0:
            resident.append(memory())
            gc.collect()
            ctypes.CDLL("libc.so.6").malloc_trim(0)
            held.append(memory())
            print(
                f"{step:9,} steps   {episodes:6,} episodes   {resident[-1]:.1f} MB, held {held[-1]:.1f}",
                flush=True,
            )
    growth = round(held[-1] - held[0], 1)
    return {
        "steps": steps,
        "episodes": episodes,
        "resident_mb": resident,
        "held_mb": held,
        "growth_mb": growth,
    }


def memory() -> float:
    """Return the resident memory (MB) that Linux reports."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * resource.getpagesize() / 1e6, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    arguments = parser.parse_args()
    began = time.perf_counter()
    result = soak(arguments.steps)
    if arguments.steps == 1_000_000:
        write_json(RESULTS, result | {"command": command_line(sys.argv), "commit": find_commit()})
    print(f"{result['growth_mb']:+.1f} MB in {time.perf_counter() - began:.0f} s")
    if result["growth_mb"] > GROWTH_MB:
        sys.exit("the memory grows")


if __name__ == "__main__":
    main()
