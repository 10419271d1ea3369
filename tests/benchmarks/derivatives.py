"""How good dynamics are that ``recipes/add_dynamics.py`` derives: our own recordings know the truth.

    uv run python tests/benchmarks/derivatives.py
    uv run python tests/benchmarks/derivatives.py --datasets datasets/bin_dropping --episodes 20 --output found.json

From the recorded positions, by central differences and by Savitzky-Golay, with noise of 0, 2, 5 and 10 mm (and 5 rad on
the angles for each metre); and from the frames. Needs ``datasets/TASK`` of the three tasks (``python recipes/collect.py
--task TASK``). Writes ``recipes/results/measurements/derivatives.json``.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import torch

from dynmap_rl.data.camera import choose_view, read_motion
from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.derive import differentiate
from dynmap_rl.data.format.reading import read_info
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements" / "derivatives.json"
TASKS = "balance_reaching", "balance_reaching_obstacle", "bin_dropping"
NOISES = 0, 2, 5, 10  # mm
TURN = 5  # rad of noise on the angles for a metre on the positions
METHODS = "central", "savgol"
Dynamics = dict[str, np.ndarray]  # by quantity, [E, T, D]


def compare(found: Dynamics, truth: Dynamics) -> dict[str, dict[str, float]]:
    """Mean absolute errors of cart and block together: of x and y (mm, mm/s, mm/s^2), and of the angles (degrees)."""
    errors = {q: np.abs(found[q] - truth[q]) for q in DYNAMICS}
    return {q: by_kind(error) for q, error in errors.items()}


def by_kind(values: np.ndarray) -> dict[str, float]:
    linear, angular = values[..., [0, 1, 3, 4]].mean(), values[..., [2, 5]].mean()
    return {"linear": 1000 * float(linear), "angular": float(np.degrees(angular))}


def derive(position: np.ndarray, method: str) -> Dynamics:
    """Differentiate positions ``[E, T, D]``."""
    time = CONTROL_DT * np.arange(position.shape[1])
    velocity, acceleration = map(
        np.stack, zip(*(differentiate(p, time, method) for p in position), strict=True)
    )
    return dict(zip(DYNAMICS, (position, velocity, acceleration), strict=True))


def from_state(truth: Dynamics) -> dict[str, dict]:
    """Errors of every method and noise."""
    found = {}
    for noise in NOISES:
        scale = noise / 1000 * np.array([1, 1, TURN] * 2)
        noisy = truth["position"] + scale * np.random.default_rng(0).standard_normal(truth["position"].shape)
        found |= {f"{method}, {noise} mm": compare(derive(noisy, method), truth) for method in METHODS}
    return found


def from_frames(root: Path, truth: Dynamics) -> dict[str, dict]:
    """Errors of tracks by every method, and of flow; the centroid against the cart, less the best constant offset."""
    info = read_info(root)
    motions = {}
    for source in ("flow", "centroid"):
        view = choose_view(root, info, source, planar=True)
        motions[source] = [
            motion for _, motion in islice(read_motion(root, info, view), len(truth["position"]))
        ]
    position = np.stack([motion.position for motion in motions["flow"]])
    tracks = {method: derive(position, method) for method in METHODS}
    velocity = np.stack([motion.velocity for motion in motions["flow"]])
    flow = {
        "position": position,
        "velocity": velocity,
        "acceleration": derive(velocity, "savgol")["velocity"],
    }
    found = {f"tracks, {method}": compare(tracks[method], truth) for method in METHODS}
    found["flow"] = compare(flow, truth)
    found["lost"] = float(1 - np.mean([motion.found.mean() for motion in motions["flow"]]))
    point = derive(np.stack([motion.position for motion in motions["centroid"]]), "savgol")
    rest = {q: point[q] - truth[q][..., :2] for q in DYNAMICS}
    rest["position"] -= np.median(rest["position"], (0, 1))
    found["centroid, savgol"] = {q: {"linear": 1000 * float(np.abs(r).mean())} for q, r in rest.items()}
    return found


def measure(root: Path, episodes: int) -> dict:
    """Errors of all sources on the first episodes of a recording."""
    dynamics = load_dataset(root)["dynamics"][: episodes or None]
    truth = {name: values.double().numpy() for name, values in dynamics.items()}
    size = {q: by_kind(np.abs(truth[q])) for q in DYNAMICS[1:]}
    return {
        "episodes": len(dynamics),
        "mean_magnitude": size,
        "state": from_state(truth),
        "frames": from_frames(root, truth),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--datasets", default=",".join(f"datasets/{task}" for task in TASKS))
    parser.add_argument("--episodes", type=int, default=0, help="of each recording; 0 is all")
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    result = {
        "command": shlex.join(["python", "tests/benchmarks/derivatives.py", *sys.argv[1:]]),
        "commit": find_commit(),
        "unit": "mm, s, degrees; mean absolute errors",
    }
    for dataset in map(Path, arguments.datasets.split(",")):
        result[dataset.name] = measure(dataset, arguments.episodes)
        write_json(arguments.output, result)
    print(arguments.output.read_text())


if __name__ == "__main__":
    main()
