"""Measure control latency on one core, in a loop of 20 Hz against the wall clock.

    uv run --extra onnx python tests/benchmarks/realtime.py            # 10,000 steps each, 8 minutes each
    uv run --extra onnx python tests/benchmarks/realtime.py --fast     # the same without sleeping between steps
    uv run --extra lerobot python tests/benchmarks/realtime.py --fast --only act,diffusion \
        --lerobot act=runs/act/checkpoints/last/pretrained_model,diffusion=runs/diffusion/checkpoints/last/pretrained_model

Latency is the time from a frame to its action. ``actor`` acts on present frames; ``delayed`` on frames that are six steps
old; ``onnx`` is ``actor`` in onnxruntime. ``--lerobot`` names policies of LeRobot, whose latency is largest in the steps in
which they predict a chunk. ``server`` is a policy in a process of its own, which works on every frame for
about ``--work`` seconds of its processor (it encodes the frame again and again), and answers with a chunk; the loop goes
on meanwhile, and its latency is the time to look up the action. It cannot be ``--fast``, as a frame would then be older
in steps. Loop and server share one core. Rows of the paced loop have names that end in ``_paced``. Writes
``recipes/results/measurements/realtime.json``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from tensordict import TensorDict

import dynmap_rl  # noqa: F401 (registers the tasks)
from dynmap_rl.envs.scene import scene_seed
from dynmap_rl.modules import ChunkActor, DelayedActor
from dynmap_rl.runs import load_actor
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

RESULT = Path(__file__).parents[2] / "recipes/results/measurements/realtime.json"
PERIOD = 0.05


class Local:
    """Actor in the process of the loop, on frames that are ``delay`` steps old."""

    def __init__(self, actor, delay: int = 0):
        self.actor, self.delay = actor.eval(), delay

    def reset(self) -> None:
        self.memory, self.frames = TensorDict({}, [1]), []
        if hasattr(self.actor, "reset"):  # a policy of LeRobot keeps its memory itself
            self.actor.reset()

    @torch.no_grad()
    def act(self, frame: np.ndarray, agent_pos: np.ndarray) -> np.ndarray:
        self.frames.append(torch.from_numpy(frame).movedim(-1, 0)[None])
        self.frames = self.frames[-self.delay - 1 :]
        agent_pos = torch.from_numpy(agent_pos)[None]
        td = (
            self.memory.set("pixels", self.frames[0])
            .set("agent_pos", agent_pos)
            .set("goal", agent_pos[:, 3:])
        )
        td = self.actor(td)
        self.memory = td.get("next", TensorDict({}, [1]))
        return td["action"][0].numpy()


class Onnx:
    """Actor in onnxruntime."""

    def __init__(self, folder: Path):
        from dynmap_rl.integrations.onnx import OnnxActor, export_to_onnx

        self.actor = OnnxActor(export_to_onnx("balance_reaching", folder))
        self.reset = self.actor.reset

    def act(self, frame: np.ndarray, agent_pos: np.ndarray) -> np.ndarray:
        return self.actor.act(frame.transpose(2, 0, 1)[None], agent_pos[None, 3:])[0]


def load_lerobot(path: str) -> Local:
    from dynmap_rl.integrations.lerobot import LeRobotActor

    return Local(LeRobotActor(path))


def answer(pipe, delay: int, size: int, work: float) -> None:
    """Answer frames with chunks, slowly; the work of a slow policy is done in fact."""
    torch.set_num_threads(1)
    actor = load_actor("balance_reaching").eval()
    chunks = ChunkActor(actor, size, delay)
    while (message := pipe.recv()) is not None:
        began, (frame, goal, step) = time.process_time(), message
        pixels = torch.from_numpy(frame).movedim(-1, 0)[None]
        chunk = chunks.act(pixels, torch.from_numpy(goal)[None], step)[0].numpy()
        with torch.no_grad():
            while time.process_time() - began < work:
                actor.world_model.encode(pixels)
        pipe.send((step, chunk))


class Server:
    """Policy in a process of its own, whose chunks come late."""

    def __init__(self, delay: int, size: int, work: float):
        self.pipe, other = multiprocessing.Pipe()
        arguments = other, delay, size, work
        self.process = multiprocessing.get_context("spawn").Process(
            target=answer, args=arguments, daemon=True
        )
        self.process.start()
        self.ages, self.empty, self.busy = [], 0, False
        self.reset()

    def reset(self) -> None:
        if self.busy:
            self.pipe.recv()  # of the episode before
        self.step, self.plan, self.busy = 0, {}, False

    def act(self, frame: np.ndarray, agent_pos: np.ndarray) -> np.ndarray:
        if self.busy and (self.step == 0 or self.pipe.poll()):
            self._receive()
        if not self.busy:
            self.pipe.send((frame, agent_pos[3:], self.step))
            self.busy = True
            if self.step == 0:  # a robot waits for its first action
                self._receive()
        action, taken = self.plan.get(self.step, (np.zeros(3, np.float32), None))
        if taken is None:
            self.empty += 1
        elif self.step > 0:
            self.ages.append(self.step - taken)
        self.step += 1
        return action

    def _receive(self) -> None:
        taken, chunk = self.pipe.recv()
        self.plan |= {taken + i: (action, taken) for i, action in enumerate(chunk)}
        self.busy = False

    def close(self) -> None:
        self.reset()
        self.pipe.send(None)
        self.process.join()


def measure(controller, steps: int, paced: bool) -> dict:
    """Run episodes one after the other, and return percentiles of the latency (ms) and the rate of success."""
    env = gym.make("dynmap_rl/BalanceReaching-v1", obs_type="pixels_agent_pos", disable_env_checker=True)
    latencies, successes, late, over, scene = [], [], 0, True, 0
    due = time.perf_counter()
    for _ in range(steps):
        if over:
            observation, _ = env.reset(seed=scene_seed("validation", scene))
            controller.reset()
            scene, first, due = scene + 1, True, time.perf_counter()
        began = time.perf_counter()
        action = controller.act(observation["pixels"], observation["agent_pos"])
        if not (first and isinstance(controller, Server)):
            latencies.append(1000 * (time.perf_counter() - began))
        observation, _, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        if over:
            successes.append(bool(info["is_success"]))
        due = time.perf_counter() if first else due
        first, due = False, due + PERIOD
        if paced:
            late += time.perf_counter() > due
            time.sleep(max(0.0, due - time.perf_counter()))
            due = max(due, time.perf_counter() - PERIOD)  # a missed period is not made up for
    p50, p99 = np.percentile(latencies, [50, 99]).tolist()
    return {
        "paced": paced,
        "steps": steps,
        "latency_ms": {"p50": p50, "p99": p99, "worst": max(latencies)},
        "missed_periods": int(late),
        "episodes": len(successes),
        "SR": 100 * float(np.mean(successes)) if successes else None,
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--fast", action="store_true", help="no sleep between steps")
    parser.add_argument("--lerobot", default="", help="policies of LeRobot: NAME=FOLDER with commas between")
    parser.add_argument("--only", default="actor,delayed,onnx,server")
    parser.add_argument(
        "--work", type=float, default=0.2, help="processor time of the server for a frame (s)"
    )
    parser.add_argument("--output", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # inherited by the server
    actor = load_actor("balance_reaching").eval()
    with tempfile.TemporaryDirectory() as folder:
        controllers = {
            "actor": lambda: Local(actor),
            "delayed": lambda: Local(DelayedActor(actor, delay=6), delay=6),
            "onnx": lambda: Onnx(Path(folder)),
            "server": lambda: Server(delay=10, size=30, work=options.work),
        }
        for name, path in (policy.split("=") for policy in filter(None, options.lerobot.split(","))):
            controllers[name] = partial(load_lerobot, path)
        for name in options.only.split(","):
            controller = controllers[name]()
            row = measure(controller, options.steps, paced=not options.fast or name == "server")
            if name == "server":
                controller.close()
                p50, p99 = np.percentile(controller.ages, [50, 99]).tolist()
                row["age_steps"] = {"p50": p50, "p99": p99, "worst": max(controller.ages)}
                row |= {"steps_without_action": controller.empty, "work_s": options.work}
            found = read_json(options.output) if options.output.exists() else {"rows": {}}
            row |= {"command": command_line(sys.argv), "commit": find_commit()}
            found["rows"][f"{name}_paced" if row["paced"] else name] = row
            found["machine"] = platform.platform()
            write_json(options.output, found)
            print(name, row, flush=True)


if __name__ == "__main__":
    main()
