"""Add dynamics columns to any LeRobot v3.0 dataset, derived from its state or tracked in its frames.

    python recipes/add_dynamics.py --dataset user/name --columns 0,1,2 --angles 2 --output datasets/name
    python recipes/add_dynamics.py --dataset user/name --source tracks --objects 2 --output datasets/name
    python recipes/add_dynamics.py --dataset user/name --source state,tracks --colors red --output datasets/name
    python recipes/add_dynamics.py --dataset user/name --source tracks --colors red --preview 3     # writes no dataset
    python recipes/add_dynamics.py --dataset datasets/balance_reaching --source tracks --replace --output datasets/tracks

World models are supervised on the columns dynamics.position, .velocity and .acceleration (see recipes/robot.py). The
dataset is copied and stays as it is; the copy appears when it is complete. The copy of a recording of a task can be
trained on with recipes/decoupled.py. The page report.html in runs/add_dynamics says how good the columns are likely to
be, and shows them.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from dynmap_rl.utils.cli import command_line, refuse, run_recipe
from dynmap_rl.utils.settings import parse_numbers


@dataclass(frozen=True)
class Config:
    """Settings of the recipe."""

    # Dataset: a folder or a hub id. Required.
    dataset: str | None = None
    # Folder of the new dataset. Required without --preview.
    output: Path | None = None
    # Number of episodes, the first ones, to derive and judge without writing a dataset.
    preview: int | None = None
    # Source of the positions: state (a column), or the frames: centroid (of all that moves), tracks (objects with angles)
    # or flow (tracks, with velocities by optical flow), or both: state,tracks or state,flow. Limits:
    # dynmap_rl/data/README.md.
    source: str = "state"
    # Column whose entries are positions.
    state: str = "observation.state"
    # Entries of that column to take, such as 0,1,2; by default all.
    columns: str | None = None
    # Entries that are angles and jump by a period.
    angles: str | None = None
    # Period of the angles: 6.2832 (rad) or 360 (degrees).
    period: float = 6.283185307179586
    # Standard deviation of noise that is added to the positions of a state, for experiments, in their unit.
    noise: float = 0.0
    # Standard deviation of noise that is added to the angles of a state.
    angle_noise: float = 0.0
    # Seed of the noise.
    noise_seed: int = 0
    # Derivatives: central (differences over both neighbours) or savgol (for noisy positions at even timestamps); by
    # default central for a state and savgol for frames.
    method: str | None = None
    # Steps of savgol's window.
    window: int = 11
    # Order of savgol's polynomial.
    order: int = 3
    # Camera's column, for sources of frames; by default the first camera.
    camera: str | None = None
    # Number of objects, for tracks and flow; by default two for a recording of cart and block, otherwise one.
    objects: int | None = None
    # Colours of the objects, names or #rrggbb, instead of objects and sort: #1c1c1c,red.
    colors: str | None = None
    # Difference of a colour channel, 0 to 255, from which on a pixel counts as moving, and colours as different.
    threshold: int = 30
    # Order of the objects: lowest (in the first frame), largest or brightest first; the same in all episodes.
    sort: str = "lowest"
    # Leave the angles of tracked objects out, as for round ones.
    point: bool = False
    # Width of the picture in m; by default 1 for a recording of cart and block, otherwise positions are in pixels.
    width: float | None = None
    # Replace existing dynamics columns, and print how far the new ones differ.
    replace: bool = False


def main(config: Config) -> None:
    """Derive the columns and report."""
    from dynmap_rl.data.demonstrations import find_meta
    from dynmap_rl.data.derive import add_dynamics
    from dynmap_rl.data.format.reading import find_dataset
    from dynmap_rl.data.quality import quality_text, worst_episode
    from dynmap_rl.reporting.dataset_page import write_dataset_page
    from dynmap_rl.reporting.html import write_html
    from dynmap_rl.reporting.track_figure import plot_tracks
    from dynmap_rl.runs.folder import plain_settings
    from dynmap_rl.utils.files import write_json

    if not config.dataset:
        raise ValueError("--dataset must be given: a folder or a hub id")
    of_state = "state", "columns", "angles", "period", "noise", "angle_noise", "noise_seed"
    of_frames = "camera", "objects", "colors", "threshold", "sort", "point", "width"
    unused = {"state": of_frames, "tracks": of_state, "flow": of_state}
    unused["centroid"] = *of_state, "objects", "colors", "sort", "point"
    refuse(config, Config(), unused.get(config.source, ()), f"--source {config.source}")
    if (config.method or config.source) in ("central", "state"):
        refuse(config, Config(), ("window", "order"), "--method central")
    if not config.angles:
        refuse(config, Config(), ("period", "angle_noise"), "a state without --angles")
    if not config.noise and not config.angle_noise:
        refuse(config, Config(), ("noise_seed",), "no --noise")
    settings = vars(config) | {
        "columns": None if config.columns is None else parse_numbers(config.columns, "--columns"),
        "angles": [] if config.angles is None else parse_numbers(config.angles, "--angles"),
        "colors": config.colors.split(",") if config.colors is not None else None,
    }
    found = add_dynamics(**settings)
    if config.output:
        print(f"written: {config.output}")
        if find_meta(find_dataset(config.dataset)) and not find_meta(config.output):
            print(
                "its dynamics are not those of its task: train with recipes/robot.py, not with recipes/decoupled.py"
            )
    lines = []
    for quantity, difference in found["differences"].items():
        entries = ", ".join(f"{value:.3g}" for value in difference)
        lines.append(f"mean absolute difference from the replaced {quantity}: {entries}")
    if config.source == "state":
        lines.append(
            "the verdict is on the state alone; --source state,tracks adds objects that are seen in the frames"
        )
    text = "\n".join([quality_text(found["quality"]), *lines])
    if found["view"]:
        text = f"frames of {found['view'].column}\n{text}"
    print(text)
    folder = Path("runs/add_dynamics_preview") / Path(config.dataset).resolve().name
    if config.output:
        folder = Path("runs/add_dynamics") / config.output.name
    command = command_line(sys.argv)
    differences = {q: difference.tolist() for q, difference in found["differences"].items()}
    try:
        write_json(
            folder / "quality.json", found["quality"] | {"differences": differences, "command": command}
        )
        (folder / "tracks.png").unlink(missing_ok=True)  # of another source
        if config.source.endswith(("tracks", "flow")):
            view = found["view"]
            episode = worst_episode(found["quality"], found["names"])
            plot_tracks(config.dataset, view, episode, folder / "tracks.png")
    except OSError as error:  # the dataset is complete
        return print(f"no page in {folder}: {error}")
    if config.output:
        return write_dataset_page(folder, config.output, plain_settings(config), command, text)
    title = f"{config.dataset}, preview of {found['episodes']} of the episodes"
    return print(f"written: {write_html(folder, title, text, command, plain_settings(config))}")


if __name__ == "__main__":
    run_recipe(
        main, Config, sys.argv, stopped="a new folder that is there is complete; otherwise repeat the command"
    )
