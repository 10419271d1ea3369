"""Add dynamics columns to any LeRobot v3.0 dataset, derived from its state or tracked in its frames.

    python recipes/add_dynamics.py --dataset user/name --columns 0,1,2 --angles 2 --output datasets/name
    python recipes/add_dynamics.py --dataset user/name --track --output datasets/name

World models are supervised on the columns dynamics.position, .velocity and .acceleration (see recipes/robot.py). The
dataset is copied and stays as it is; the copy appears when it is complete. The page report.html in runs/add_dynamics
shows the columns.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line, refuse, run_recipe


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Dataset: a folder or a hub id. Required.
    dataset: str | None = None
    # Folder of the new dataset. Required.
    output: Path | None = None
    # Column whose entries are positions.
    state: str = "observation.state"
    # Entries of that column to take, such as 0,1,2; by default all.
    columns: str | None = None
    # Entries that are angles and jump by a period.
    angles: str | None = None
    # Period of the angles: 6.2832 (rad) or 360 (degrees).
    period: float = 6.283185307179586
    # Derivatives: central (differences over both neighbours) or savgol (for noisy positions at even timestamps).
    method: str = "central"
    # Steps of savgol's window.
    window: int = 11
    # Order of savgol's polynomial.
    order: int = 3
    # Take positions from the frames instead: the centroid of what moves, in pixels (limits: dynmap_rl/data/README.md).
    track: bool = False
    # Camera's column for --track; by default the first camera.
    camera: str | None = None
    # Difference of a colour channel, 0 to 255, from which on a pixel counts as moving, for --track.
    threshold: int = 30
    # Replace existing dynamics columns, and print how far the new ones differ.
    replace: bool = False


def main(config: Config) -> None:
    """Derive the columns and report."""
    from dynmap_rl.data.derive import add_dynamics, parse_entries
    from dynmap_rl.reporting.dataset_page import write_dataset_page
    from dynmap_rl.runs.folder import plain_settings

    if not config.dataset or not config.output:
        raise ValueError("--dataset and --output must be given: the dataset, and the folder of the new one")
    if config.track:
        refuse(config, Config(), ("state", "columns", "angles", "period"), "--track")
    else:
        refuse(config, Config(), ("camera", "threshold"), "positions of a state; add --track")
    settings = vars(config) | {
        "columns": parse_entries(config.columns, "--columns"),
        "angles": parse_entries(config.angles, "--angles") or [],
    }
    differences = add_dynamics(**settings)
    print(f"written: {config.output}")
    lines = []
    for quantity, difference in differences.items():
        entries = ", ".join(f"{value:.3g}" for value in difference)
        lines.append(f"  mean absolute difference from the replaced {quantity}: {entries}")
        print(lines[-1])
    folder = Path("runs/add_dynamics") / config.output.name
    command = command_line(sys.argv)
    write_dataset_page(folder, config.output, plain_settings(config), command, "\n".join(lines))


if __name__ == "__main__":
    run_recipe(main, Config, sys.argv)
