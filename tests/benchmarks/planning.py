"""Write the table of ``PLANNING.md``: what a dataset needs, by the rates that the other scripts have measured.

    python tests/benchmarks/planning.py                        # for a million episodes
    python tests/benchmarks/planning.py --episodes 100000 --core_hour 0.04 --gpu_hour 2

Reads ``dataset_size.json``, ``benchmarks.json`` and ``updates_*.json`` in ``recipes/results/measurements``; what has not been
measured is left out. Prices are assumptions, to be replaced by those of the machines at hand.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from pathlib import Path

from dynmap_rl.envs.world import EPISODE_STEPS
from dynmap_rl.utils.files import read_json, write_bytes

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements"
PAGE = Path(__file__).with_name("PLANNING.md")
START, END = "<!-- written by tests/benchmarks/planning.py -->", "<!-- end -->"


@dataclass(frozen=True)
class Prices:
    """Prices in dollars: of an hour of a core and of a GPU with its host, and of a gigabyte of SSD for a month."""

    core_hour: float = 0.05
    gpu_hour: float = 3.0
    gb_month: float = 0.08


def list_needs(results: Path, episodes: int, prices: Prices = Prices()) -> dict[str, tuple[str, float]]:
    """Return what a number of episodes needs and costs ($), in proportion to the measured sizes and rates."""
    needs, frames = {}, episodes * EPISODE_STEPS
    path = results / "benchmarks.json"
    if recording := path.exists() and read_json(path)["rows"].get("recording"):
        hours = episodes / recording["episodes"] * recording["theirs"] / 3600
        needs["recording"] = f"{hours:,.0f} hours of a core", hours * prices.core_hour
    if (path := results / "dataset_size.json").exists():
        rows = read_json(path)["rows"]
        row = max((row for name, row in rows.items() if name.isdigit()), key=lambda row: row["episodes"])
        share = episodes / row["episodes"]
        for name, key in (("files of the dataset", "files_MB"), ("decoded frames", "cache_MB")):
            size = row[key] * share / 1e3
            needs[f"{name}, a month"] = f"{size:,.0f} GB", size * prices.gb_month
        hours = row["cold"]["load_s"] * share / 3600
        needs["decoding, once"] = f"{hours:,.1f} hours of a core", hours * prices.core_hour
        text = f"{row['warm']['private_MB']:,.0f} MB, whatever the number of episodes"
        needs["private memory of a process"] = text, 0.0
    for path in sorted(results.glob("updates_*.json")):
        found = read_json(path)
        best = max(found["rows"], key=lambda row: row["frames_per_s"])
        hours = frames / best["frames_per_s"] / 3600
        price = prices.gpu_hour if path.stem == "updates_cuda" else found["threads"] * prices.core_hour
        text = f"{hours:,.0f} hours at {best['frames_per_s']:,.0f} frames/s"
        needs[f"training, every frame once, {found['device']}"] = text, hours * price
    return needs


def page(text: str, results: Path = RESULTS, episodes: int = 1_000_000, prices: Prices = Prices()) -> str:
    """Return the text of the page with its table written anew."""
    lines = [f"| {episodes:,} episodes | need | cost |", "|---|---|---|"]
    for name, (need, cost) in list_needs(results, episodes, prices).items():
        lines.append(f"| {name} | {need} | {f'${cost:,.2f}' if cost else ''} |")
    lines.append(
        f"\nAssumed prices: ${prices.core_hour} for an hour of a core, ${prices.gpu_hour} for an hour of a GPU with its "
        f"host, ${prices.gb_month} for a month of a gigabyte of SSD. They are not quotes: write the table again with those "
        "of your machines."
    )
    before, _, rest = text.partition(START)
    _, _, after = rest.partition(END)
    return before + "\n\n".join([START, "\n".join(lines), END]) + after


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=1_000_000)
    for price in fields(Prices):
        parser.add_argument(f"--{price.name}", type=float, default=price.default, help="$")
    options = parser.parse_args()
    prices = Prices(options.core_hour, options.gpu_hour, options.gb_month)
    write_bytes(PAGE, page(PAGE.read_text(), episodes=options.episodes, prices=prices).encode())


if __name__ == "__main__":
    main()
