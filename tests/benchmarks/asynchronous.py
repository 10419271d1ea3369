"""Measure success where LeRobot's policy server is slow: server and robot client on loopback, in real time.

    uv run --extra async python tests/benchmarks/asynchronous.py --episodes 50

The server, in a process of its own, takes ``--latency`` seconds for a chunk (LeRobot's ``--inference_latency``). The
robot is the Gymnasium environment, which takes a control step every 50 ms. Episodes are in real time, so that a busy
machine delays frames even more. Every scene is played with ``--policy.delay`` and with ``--policy.delay=0``, where a
chunk does not begin with the actions that the robot executes while it is on its way. Success without a delay is that of
the same scenes in simulated time. Writes ``recipes/results/measurements/asynchronous.json``, after every episode; a
second call goes on.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import torch

from dynmap_rl.evaluation import Evaluation, evaluate, wilson
from dynmap_rl.runs import load_actor
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

RESULT = Path(__file__).parents[2] / "recipes/results/measurements/asynchronous.json"
FPS = 20


@contextlib.contextmanager
def serve(latency: float, folder: Path):
    """Run the policy server in a process of its own and yield its address; ``folder`` gets its log."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "dynmap_rl.integrations.lerobot.policy_server", f"--port={port}"]
    command += ["--host=127.0.0.1", f"--fps={FPS}", f"--inference_latency={latency}"]
    threads = {"OMP_NUM_THREADS": "1"}
    with (folder / "server.txt").open("w") as log:
        server = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, env=os.environ | threads)
        try:
            for _ in range(1200):
                if server.poll() is not None:
                    raise RuntimeError(f"the server ended:\n{(folder / 'server.txt').read_text()}")
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
                    break
                time.sleep(0.1)
            yield f"127.0.0.1:{port}"
        finally:
            server.terminate()
            server.wait()


def play(policy: Path, address: str, scene: int, split: str = "test", chunk: int = 20) -> dict:
    """Play one episode with LeRobot's robot client.

    Returns:
        Outcome of the episode; ``held``, the steps for which no action had come; and ``late``, for each chunk after the
        first, the steps from its frame to its first action that could still be executed.
    """
    from lerobot.async_inference.configs import RobotClientConfig
    from lerobot.async_inference.robot_client import RobotClient

    from dynmap_rl.integrations.lerobot import DynmapRobotConfig

    config = RobotClientConfig(
        policy_type="dynmap",
        pretrained_name_or_path=str(policy),
        robot=DynmapRobotConfig(scene=scene, split=split, calibration_dir=policy / "calibration"),
        actions_per_chunk=chunk,
        server_address=address,
        chunk_size_threshold=1.0,  # every frame is sent
        fps=FPS,
        aggregate_fn_name="latest_only",
    )
    client, late = RobotClient(config), []
    aggregate = client._aggregate_action_queues

    def watch(chunk, function=None):
        late.append(client.latest_action + 1 - chunk[0].get_timestep())
        aggregate(chunk, function)

    client._aggregate_action_queues = watch
    if not client.start():
        raise RuntimeError("the client did not reach the server")
    threads = [threading.Thread(target=client.receive_actions)]
    threads.append(threading.Thread(target=client.control_loop, args=("",)))
    for thread in threads:
        thread.start()
    while not client.robot.over and all(thread.is_alive() for thread in threads):
        time.sleep(0.02)
    client.shutdown_event.set()
    for thread in threads:
        thread.join()
    info = client.robot.info
    client.stop()
    return {
        "scene": scene,
        "success": bool(info["is_success"]),
        "dropped": bool(info["dropped"]),
        "position_error": round(float(info["position_error"]), 4),
        "held": client.robot.held,
        "late": late[1:],
    }


def summarize(rows: list[dict]) -> dict:
    """Return rates (%) with intervals, and how late chunks came."""
    late, count = [steps for row in rows for steps in row["late"]], len(rows)
    return {
        "episodes": count,
        "SR": 100 * sum(row["success"] for row in rows) / count,
        "SR_interval": wilson(sum(row["success"] for row in rows), count),
        "DR": 100 * sum(row["dropped"] for row in rows) / count,
        "PE": 1000 * statistics.mean(row["position_error"] for row in rows),
        "late_steps_median": statistics.median(late),
        "late_steps_longest": max(late),
        "held_steps": sum(row["held"] for row in rows),
    }


def export(run: str, folder: Path, delay: int) -> Path:
    """Write the policy of a run for LeRobot, with a delay."""
    from dynmap_rl.integrations.lerobot import export_to_lerobot

    policy = export_to_lerobot(run, folder / f"delay_{delay}")
    settings = read_json(policy / "config.json")
    write_json(policy / "config.json", settings | {"delay": delay, "device": "cpu"})
    return policy


def main() -> None:
    """Play and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--run", default="balance_reaching")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--split", default="test")
    parser.add_argument("--latency", type=float, default=0.3, help="seconds")
    parser.add_argument("--delay", type=int, default=8, help="--policy.delay, in steps")
    parser.add_argument("--output", type=Path, default=RESULT)
    options = parser.parse_args()
    torch.set_num_threads(1)
    settings = {name: getattr(options, name) for name in ("run", "split", "latency", "delay")}
    found = read_json(options.output) if options.output.exists() else {}
    if {name: found.get(name) for name in settings} != settings:
        found = settings | {"conditions": {}}
    rows = {name: part["rows"] for name, part in found["conditions"].items()}
    with tempfile.TemporaryDirectory() as folder, serve(options.latency, Path(folder)) as address:
        os.chdir(folder)  # LeRobot writes logs where it runs
        policies = {
            f"delay_{delay}": export(options.run, Path(folder), delay) for delay in (options.delay, 0)
        }
        for scene in range(options.episodes):
            for name, policy in policies.items():
                done = rows.setdefault(name, [])
                if len(done) > scene:
                    continue
                done.append(play(policy, address, scene, options.split))
                print(name, done[-1], flush=True)
                found["conditions"] = {
                    n: summarize(part) | {"rows": part} for n, part in rows.items() if part
                }
                found |= {"command": command_line(sys.argv), "commit": find_commit()}
                write_json(options.output, found)
    test = evaluate(
        load_actor(options.run), "balance_reaching", Evaluation(options.split, options.episodes, 0)
    )
    found["without_delay"] = test["test"]["summary"]
    write_json(options.output, found)
    for name, part in {"without delay": found["without_delay"], **found["conditions"]}.items():
        print(name, {key: value for key, value in part.items() if key != "rows"})


if __name__ == "__main__":
    main()
