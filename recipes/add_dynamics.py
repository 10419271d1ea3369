"""Give any LeRobot v3.0 dataset dynamics columns, derived from its state or from what moves in its frames.

    python recipes/add_dynamics.py --dataset user/name --columns 0,1,2 --angles 2 --output datasets/name
    python recipes/add_dynamics.py --dataset user/name --track --output datasets/name

`dynamics.position`, `.velocity` and `.acceleration` are what the world models of recipes/decoupled.py and
recipes/joint.py are supervised on. The dataset stays as it is; the new one appears when it is whole. A page in
runs/add_dynamics, `report.html`, shows them.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import refuse
from dynmap_rl.utils.cli import run_recipe


@dataclass
class Config:
    # Dataset: a folder or a hub id. Must be given.
    dataset: str | None = None
    # Folder of the new dataset. Must be given.
    output: Path | None = None
    # Column whose entries are positions.
    state: str = "observation.state"
    # Which of its entries, such as 0,1,2; by default all.
    columns: str | None = None
    # Those of the entries that are angles and jump by a period.
    angles: str | None = None
    # The period: 6.2832 (rad) or 360 (degrees).
    period: float = 6.283185307179586
    # Derivatives: central (differences over both neighbours) or savgol (for noisy positions at even timestamps).
    method: str = "central"
    # Steps of savgol's window.
    window: int = 11
    # Order of savgol's polynomial.
    order: int = 3
    # Take positions from the frames instead: the centroid, in pixels, of what moves (see dynmap_rl/data/tracking.py for
    # what it cannot do).
    track: bool = False
    # In which camera; by default the first.
    camera: str | None = None
    # How much of 255 a pixel must change to count as moving.
    threshold: int = 30
    # Replace dynamics columns that are there, and say how far the new ones are from them.
    replace: bool = False


def main(config: Config) -> None:
    from dynmap_rl.data.derive import add_dynamics
    from dynmap_rl.data.derive import parse_entries
    from dynmap_rl.reporting.dataset_page import write_dataset_page

    if not config.dataset or not config.output:
        raise ValueError("name the dataset with --dataset and the new folder with --output")
    if config.track:
        refuse(config, ("state", "columns", "angles", "period"), "says nothing with --track")
    else:
        refuse(config, ("camera", "threshold"), "says nothing without --track")
    settings = vars(config) | {
        "columns": parse_entries(config.columns, "--columns"),
        "angles": parse_entries(config.angles, "--angles") or [],
    }
    differences = add_dynamics(**settings)
    print(f"done: {config.output}")
    lines = []
    for quantity, difference in differences.items():
        entries = ", ".join(f"{value:.3g}" for value in difference)
        lines.append(f"  {quantity} differs from the column that was there by {entries} on average")
        print(lines[-1])
    folder = Path("runs/add_dynamics") / config.output.name
    write_dataset_page(folder, config.output, dataclasses.asdict(config), "\n".join(lines))


if __name__ == "__main__":
    run_recipe(main, Config)
