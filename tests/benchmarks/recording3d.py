"""Frames a second of recording and of LeRobot's evaluation of the MuJoCo tasks, beside the benchmarks' own rendering.

    uv run --extra mujoco python tests/benchmarks/recording3d.py
    uv run --extra mujoco python tests/benchmarks/recording3d.py --tasks Soccer --episodes 5 --output found.json

``ours`` records a dataset, with resets, failures of the expert, dynamics, frames and files. ``lerobot`` takes random actions in
four worlds of ``lerobot-eval --env.type=dynmap --eval.use_async_envs=false``, without a policy. ``theirs`` takes random actions
in the benchmark's environment and calls ``env.render()``, at the same size. All have one thread, and turns of some seconds, so
that a machine whose speed changes is equally fast for all. The rates are by the time of the processor (which leaves out
other load) and by the clock; loading the model, once a process, is left out.
Writes ``recipes/results/measurements/recording3d.json``.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import gymnasium

from dynmap_rl.data.recording.shards import Shard, record_shard
from dynmap_rl.envs.tasks import get_task
from dynmap_rl.paper.benchmarks import TASKS
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

os.environ.setdefault("MUJOCO_GL", "egl")  # read by their renderer when it is made
RESULTS = Path(__file__).parents[2] / "recipes/results/measurements" / "recording3d.json"
SIZE = 64


def measure(run: Callable[[], int]) -> dict[str, float]:
    """Return seconds by the processor's time and by the clock, and the number of frames, which ``run`` returns."""
    clock, cpu = time.perf_counter(), time.process_time()
    frames = run()
    return {
        "frames": frames,
        "cpu": time.process_time() - cpu,
        "clock": time.perf_counter() - clock,
    }


def make_theirs(task: str) -> gymnasium.Env:
    """Make the environment of a task as its authors render it, with frames of our size."""
    environment = get_task(f"mujoco:{task}").environment
    if task.startswith("Fetch"):
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(environment, render_mode="rgb_array", width=SIZE, height=SIZE)
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{environment}-goal-observable"](render_mode="rgb_array")
    env.mujoco_renderer.width = env.mujoco_renderer.height = SIZE  # its viewer is made later
    return env


def record(task: str, episodes: int) -> dict[str, float]:
    """Measure a part of a dataset, as one process records it."""
    name = f"mujoco:{task}"
    with TemporaryDirectory() as folder:
        shards = [
            Shard(Path(folder, str(number)), name, name, "demonstrations", "validation", number, count)
            for number, count in enumerate((1, episodes))
        ]
        record_shard(shards[0])  # loads models and libraries

        def run() -> int:
            record_shard(shards[1])
            return episodes * get_task(name).layout.steps

        return measure(run)


def render(task: str, frames: int) -> dict[str, float]:
    """Measure their environment, with random actions."""
    env, steps = make_theirs(task), get_task(f"mujoco:{task}").layout.steps
    env.reset(seed=0)
    env.render()

    def run() -> int:
        for frame in range(frames):
            if frame % steps == 0:
                env.reset(seed=frame)
            env.step(env.action_space.sample())
            env.render()
        return frames

    return measure(run)


def evaluate(task: str, frames: int) -> dict[str, float]:
    """Measure LeRobot's environment with four worlds, with random actions."""
    from dynmap_rl.integrations.lerobot.environment import DynmapEnvConfig

    env = DynmapEnvConfig(task=f"mujoco:{task}").create_envs(4)["dynmap"][0]
    env.reset(seed=0)

    def run() -> int:
        for _ in range(max(1, frames // 4)):
            env.step(env.action_space.sample())
        return 4 * max(1, frames // 4)

    return measure(run)


def compare(task: str, episodes: int, frames: int, rounds: int) -> dict:
    """Measure a task, each part in a process of its own: renderers of one process share their settings."""
    parts = {
        "ours": (record, task, episodes),
        "lerobot": (evaluate, task, 10 * frames),
        "theirs": (render, task, frames),
    }
    found = {name: [] for name in parts}
    with ExitStack() as stack:
        pools = [stack.enter_context(ProcessPoolExecutor(1, get_context("spawn"))) for _ in parts]
        for _ in range(rounds):
            for pool, (name, call) in zip(pools, parts.items(), strict=True):
                found[name].append(pool.submit(*call).result())
    totals = {name: {key: sum(row[key] for row in rows) for key in rows[0]} for name, rows in found.items()}
    rates = {name: {key: t["frames"] / t[key] for key in ("cpu", "clock")} for name, t in totals.items()}
    return rates | {"ratio": rates["ours"]["cpu"] / rates["theirs"]["cpu"]}


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--tasks", default=",".join(TASKS))
    parser.add_argument("--episodes", type=int, default=8, help="episodes that are recorded in a round")
    parser.add_argument(
        "--frames", type=int, default=30, help="frames of the benchmark's own rendering in a round"
    )
    parser.add_argument("--rounds", type=int, default=3, help="turns of both")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = {
        task: compare(task, options.episodes, options.frames, options.rounds)
        for task in options.tasks.split(",")
    }
    for task, row in rows.items():
        rates = (f"{name} {row[name]['cpu']:.0f}" for name in ("ours", "lerobot", "theirs"))
        print(f"{task}, frames/s of one core: {', '.join(rates)}")
    write_json(options.output, {"tasks": rows, "command": command_line(sys.argv), "commit": find_commit()})


if __name__ == "__main__":
    main()
