"""How near tracks in the frames of a MuJoCo task are to its bodies, which the recording knows.

    uv run --extra mujoco python tests/benchmarks/tracks3d.py
    uv run --extra mujoco python tests/benchmarks/tracks3d.py --recording datasets/few --output found.json

The frames measure pixels, and the table is seen at an angle: x and y of a body are fitted by a polynomial of second
order of the pixels, over all training steps; what remains is the distance. Derives ``datasets/fetch_push_tracks`` and
``datasets/fetch_push_color`` beside the recording where they are missing, from ``datasets/fetch_push``
(``python recipes/collect.py --task mujoco:FetchPush``). Writes ``recipes/results/measurements/tracks3d.json``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from dynmap_rl.data.demonstrations import load_dataset, load_meta
from dynmap_rl.paper.benchmarks import DERIVED, derive_dataset
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements" / "tracks3d.json"
TRUTH = {"object": slice(0, 2), "hand": slice(-3, -1)}  # x and y among the recorded positions


def distance(pixels: torch.Tensor, body: torch.Tensor) -> float:
    """Return the median distance (mm) of a body ``[N, 2]`` (m) from a polynomial of the pixels ``[N, 2]``."""
    x, y = ((pixels - pixels.mean(0)) / pixels.std(0)).unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    fitted = terms @ torch.linalg.lstsq(terms, body).solution
    return 1000 * float((fitted - body).norm(dim=-1).median())


def compare(tracks: Path, recording: Path) -> dict[str, dict[str, float]]:
    """Return the distance from every body by tracked object."""
    found, truth = (
        load_dataset(root, "train")["dynamics", "position"].double() for root in (tracks, recording)
    )
    names = load_meta(tracks)["layout"]["position"]
    result = {}
    for i, name in enumerate(names):
        if name.startswith("object") and name.endswith("_x"):
            pixels = found[..., i : i + 2].flatten(0, 1)
            result[name.removesuffix("_x")] = {
                body: distance(pixels, truth[..., entries].flatten(0, 1)) for body, entries in TRUTH.items()
            }
    return result


def main() -> None:
    """Derive, compare and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--recording", type=Path, default=Path("datasets/fetch_push"))
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = {row: name for row, (name, _) in DERIVED.items() if name != "hand"}
    distances = {}
    for row, name in rows.items():
        folder = options.recording.with_name(f"{options.recording.name}_{name}")
        derive_dataset("FetchPush", options.recording, row, folder)
        distances[row] = compare(folder, options.recording)
        print(row, distances[row])
    result = {"task": "FetchPush", "median_distance_mm": distances}
    write_json(options.output, result | {"command": command_line(sys.argv), "commit": find_commit()})


if __name__ == "__main__":
    main()
