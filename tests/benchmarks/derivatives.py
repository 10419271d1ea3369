"""How good dynamics are that ``recipes/add_dynamics.py`` derives: our own recordings know the truth.

    uv run python tests/benchmarks/derivatives.py

From the recorded positions, by central differences and by Savitzky-Golay, with and without noise of 2 mm and 0.01 rad
on them; and from the frames. Needs ``datasets/balance_reaching`` (``python recipes/collect.py``). Writes
``recipes/results/measurements/derivatives.json``.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch

from dynmap_rl.data.demonstrations import load_dataset
from dynmap_rl.data.derive import add_dynamics, differentiate
from dynmap_rl.envs.world import CONTROL_DT
from dynmap_rl.utils.files import write_json

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements" / "derivatives.json"
DATASET = "datasets/balance_reaching"
QUANTITIES = "velocity", "acceleration"
NOISE = np.array([0.002, 0.002, 0.01] * 2)  # m, m, rad
PIXEL = 1 / 64  # m


def derived(truth: dict[str, np.ndarray], method: str, noise: float) -> dict[str, dict[str, float]]:
    """Mean absolute errors, cart and block together: of x and y (m/s, m/s^2), and of the angles (rad/s, rad/s^2)."""
    rng = np.random.default_rng(0)
    time = CONTROL_DT * np.arange(truth["position"].shape[1])
    errors = {quantity: [] for quantity in QUANTITIES}
    for i, position in enumerate(truth["position"]):
        noisy = position + noise * NOISE * rng.standard_normal(position.shape)
        for quantity, values in zip(QUANTITIES, differentiate(noisy, time, method), strict=True):
            errors[quantity].append(np.abs(values - truth[quantity][i]))
    return {quantity: _by_kind(np.stack(values)) for quantity, values in errors.items()}


def _by_kind(values: np.ndarray) -> dict[str, float]:
    linear, angular = values[..., [0, 1, 3, 4]].mean(), values[..., [2, 5]].mean()
    return {"linear": float(linear), "angular": float(angular)}


def tracked(truth: dict[str, np.ndarray]) -> dict[str, float]:
    """The centroid of what moves against the cart: mean absolute error of x (m), with the best constant offset, and how
    its velocity correlates with the cart's."""
    with tempfile.TemporaryDirectory() as folder:
        add_dynamics(DATASET, Path(folder) / "tracked", track=True, replace=True)
        found = _read_tracked(Path(folder) / "tracked")
    x, velocity = found["position"][..., 0] * PIXEL, found["velocity"][..., 0]
    difference = x - truth["position"][..., 0]
    correlation = np.corrcoef(velocity.ravel(), truth["velocity"][..., 0].ravel())[0, 1]
    return {
        "x_error_m": float(np.abs(difference - np.median(difference)).mean()),
        "velocity_correlation": float(correlation),
    }


def _read_tracked(root: Path) -> dict[str, np.ndarray]:
    episodes = load_dataset(root)["dynamics"]
    return {name: episodes[name].double().numpy() for name in ("position", "velocity")}


def main() -> None:
    torch.set_num_threads(1)
    dynamics = load_dataset(DATASET)["dynamics"]
    truth = {name: values.double().numpy() for name, values in dynamics.items()}
    result = {
        "command": "python tests/benchmarks/derivatives.py",
        "unit": "m, s, rad; mean absolute errors",
        "mean_magnitude": {q: _by_kind(np.abs(truth[q])) for q in QUANTITIES},
        "derived": {
            f"{method}{', noisy' if noise else ''}": derived(truth, method, noise)
            for method in ("central", "savgol")
            for noise in (0, 1)
        },
        "tracked": tracked(truth),
    }
    write_json(RESULTS, result)
    print(RESULTS.read_text())


if __name__ == "__main__":
    main()
