"""Write the table of ``PLANNING.md``: what a dataset needs, by the rates that the other scripts have measured.

    python tests/benchmarks/planning.py                        # for a million episodes
    python tests/benchmarks/planning.py --episodes 100000

Reads ``dataset_size.json`` and ``updates_*.json`` in ``recipes/results/measurements``; what has not been measured is left
out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.utils.files import read_json, write_bytes

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements"
PAGE = Path(__file__).with_name("PLANNING.md")
START, END = "<!-- written by tests/benchmarks/planning.py -->", "<!-- end -->"


def list_needs(results: Path, episodes: int) -> dict[str, str]:
    """Return what a number of episodes needs, in proportion to the measured sizes and rates."""
    needs, frames = {}, episodes * EPISODE_STEPS
    if (path := results / "dataset_size.json").exists():
        rows = read_json(path)["rows"]
        row = max((row for name, row in rows.items() if name.isdigit()), key=lambda row: row["episodes"])
        share = episodes / row["episodes"]
        needs["files of the dataset"] = f"{row['files_MB'] * share / 1e3:,.0f} GB"
        needs["decoded frames"] = f"{row['cache_MB'] * share / 1e3:,.0f} GB"
        needs["decoding, once"] = f"{row['cold']['load_s'] * share / 3600:,.1f} hours"
        needs["private memory of a process"] = (
            f"{row['warm']['private_MB']:,.0f} MB, whatever the number of episodes"
        )
    for path in sorted(results.glob("updates_*.json")):
        found = read_json(path)
        best = max(found["rows"], key=lambda row: row["frames_per_s"])
        text = f"{frames / best['frames_per_s'] / 3600:,.0f} hours at {best['frames_per_s']:,.0f} frames/s"
        needs[f"training, every frame once, {found['device']}"] = text
    return needs


def page(text: str, results: Path = RESULTS, episodes: int = 1_000_000) -> str:
    """Return the text of the page with its table written anew."""
    lines = [f"| {episodes:,} episodes need | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for name, value in list_needs(results, episodes).items()]
    before, _, rest = text.partition(START)
    _, _, after = rest.partition(END)
    return before + "\n\n".join([START, "\n".join(lines), END]) + after


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1_000_000)
    options = parser.parse_args()
    write_bytes(PAGE, page(PAGE.read_text(), episodes=options.episodes).encode())


if __name__ == "__main__":
    main()
