"""Measure cost against size, for 1, 10 and 100 times as many demonstrations, worlds and evaluated episodes.

    uv run python tests/benchmarks/scaling.py

Writes ``recipes/results/measurements/scaling.json`` and ``recipes/results/media/scaling.png``, where a straight line of
slope one is linear cost.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import matplotlib
import torch
from timing import seconds

from dynmap_rl.data import load_dataset, load_meta, record_dataset
from dynmap_rl.envs.scene import scene_seeds
from dynmap_rl.envs.torchrl_env import DynmapBatchedEnv
from dynmap_rl.evaluation.rollout import roll_out
from dynmap_rl.modules.actor import Actor
from dynmap_rl.modules.checkpoints import make_policy, make_world_model
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements"
FACTORS = 1, 10, 100


def demonstrations(count: int, folder: Path) -> tuple[float, float]:
    """Seconds to record ``count`` episodes, and to load them."""
    folder = folder / str(count)
    record = seconds(lambda: record_dataset(folder, episodes=count, eval_episodes=1, workers=1))
    return record, seconds(lambda: load_dataset(folder))


def worlds(count: int, steps: int = 20) -> float:
    """Seconds for a control step of ``count`` worlds."""
    env = DynmapBatchedEnv(num_envs=count, seed=0)
    td = env.reset().set("action", torch.zeros(count, 3))
    return seconds(lambda: [env.step(td) for _ in range(steps)]) / steps


def evaluated(count: int, constants: dict) -> float:
    """Seconds for ``count`` closed-loop episodes."""
    world_model = make_world_model(constants, ("position", "velocity")).eval()
    actor = Actor(world_model, make_policy(constants, "recurrent", world_model).eval(), mixed=True)
    return seconds(lambda: roll_out(actor, "balance_reaching", scene_seeds("validation", count)))


def measure() -> dict[str, list[list[float]]]:
    """Name to pairs of size and seconds."""
    torch.set_num_threads(1)
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        demonstrations(1, Path(folder))  # imports do not depend on the size
        sizes = [4 * factor for factor in FACTORS]
        times = [demonstrations(size, Path(folder)) for size in sizes]
        constants = load_meta(Path(folder) / str(sizes[-1]))["normalization"]
    for name, column in zip(("demonstrations recorded", "demonstrations loaded"), (0, 1), strict=True):
        found[name] = [[size, time[column]] for size, time in zip(sizes, times, strict=True)]
    found["worlds, a control step"] = [[n, worlds(n)] for n in (16 * factor for factor in FACTORS)]
    found["episodes evaluated"] = [[n, evaluated(n, constants)] for n in (10 * factor for factor in FACTORS)]
    return found


def draw(found: dict, path: Path) -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for name, pairs in found.items():
        sizes, times = zip(*pairs, strict=True)
        [line] = axes.loglog(sizes, times, "o-", label=name)
        axes.loglog(sizes, [times[-1] * size / sizes[-1] for size in sizes], ":", color=line.get_color())
    axes.set(xlabel="size", ylabel="time (s); dotted: proportional to size")
    figure.legend(loc="outside upper center", ncols=2)  # within the axes it would hide a point
    figure.savefig(path, dpi=120)


def main() -> None:
    found = measure()
    for name, pairs in found.items():
        print(name, ", ".join(f"{size}: {time:.3g} s" for size, time in pairs))
    write_json(
        RESULTS / "scaling.json",
        {"seconds": found, "command": command_line(sys.argv), "commit": find_commit()},
    )
    draw(found, RESULTS.with_name("media") / "scaling.png")


if __name__ == "__main__":
    main()
