"""Measure loading and windows of datasets that are larger than memory allows, each in a process of its own.

    python tests/benchmarks/dataset_size.py                              # 350, 1,000 and 10,000 episodes; 35 GB of disk
    python tests/benchmarks/dataset_size.py --episodes 350,1000

Datasets are copies of the episodes of a recording, one after the other; the row ``two_cameras`` has two cameras of
128 x 128 pixels, whose frames are those of the recording, enlarged. ``cold`` decodes the dataset into its cache, ``warm``
maps the cache. Memory is the largest private memory of the process (``RssAnon``), without the pages of the cache, which the
operating system can drop. Writes ``recipes/results/measurements/dataset_size.json`` and
``recipes/results/media/dataset_size.png``; ``--draw`` writes the figure alone, from the stored numbers.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import sys
import tempfile
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import matplotlib
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from dynmap_rl.data import load_demonstrations, load_meta, sample_windows
from dynmap_rl.data.format.images import decode_image
from dynmap_rl.envs.task import LAYOUT
from dynmap_rl.keys import CAMERA, CAMERAS
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.files import read_json, write_json
from dynmap_rl.utils.version import find_commit

RESULT = Path(__file__).parents[2] / "recipes/results/measurements/dataset_size.json"
FIGURE = RESULT.parents[1] / "media/dataset_size.png"
WINDOWS, STEPS, DRAWS = 12, 24, 300
SECOND, SIDE = f"{CAMERAS}side", 128


def tile(source: Path, into: Path, count: int, enlarge: bool = False) -> None:
    """Write a dataset of ``count`` episodes, which are those of ``source`` in turn."""
    files = sorted((source / "data").glob("*/*.parquet"))
    (into / "data/chunk-000").mkdir(parents=True)
    done = frames = number = 0
    while done < count:
        table = pq.read_table(files[number % len(files)]).sort_by("index")
        episode = table["episode_index"].to_numpy()
        episode = episode - episode[0] + done
        table = table.filter(pa.array(episode < count))
        episode = episode[episode < count]
        new = {"episode_index": episode, "index": range(frames, frames + len(table))}
        for name, values in new.items():
            table = table.set_column(table.column_names.index(name), name, pa.array(values, pa.int64()))
        if enlarge:
            table = add_camera(table)
        pq.write_table(table, into / f"data/chunk-000/file-{number:03d}.parquet")
        done, frames, number = int(episode[-1]) + 1, frames + len(table), number + 1
    info = json.loads((source / "meta/info.json").read_text())
    held_out = max(1, count // 7)
    splits = {"train": [0, count - held_out], "eval": [count - held_out, count]}
    info |= {"total_frames": frames, "total_episodes": count}
    info["splits"] = {name: f"{a}:{b}" for name, (a, b) in splits.items()}
    meta = load_meta(source) | {"splits": splits, "episodes": []}
    if enlarge:
        camera = info["features"][CAMERA] | {"shape": [SIDE, SIDE, 3]}
        info["features"] |= {CAMERA: camera, SECOND: camera}
        meta["layout"] = LAYOUT.to_dict() | {"image_size": SIDE, "cameras": ["front", "side"]}
    write_json(into / "meta/info.json", info)
    write_json(into / "meta/dynmap.json", meta)


def add_camera(table: pa.Table) -> pa.Table:
    """Enlarge the frames, and add them once more as those of a second camera."""
    rows = []
    for file in table[CAMERA].combine_chunks().field("bytes"):
        frame = cv2.resize(
            decode_image(file.as_buffer(), 64 * 64), (SIDE, SIDE), interpolation=cv2.INTER_NEAREST
        )
        rows.append({"bytes": cv2.imencode(".png", frame[..., ::-1])[1].tobytes(), "path": None})
    column = pa.array(rows, table.schema.field(CAMERA).type)
    table = table.set_column(table.column_names.index(CAMERA), CAMERA, column)
    return table.append_column(SECOND, column)


class Watch:
    """Largest private memory (MB) of this process since the watch began."""

    def __init__(self):
        self.largest, self.running = 0.0, True
        self.thread = threading.Thread(target=self._watch, daemon=True)
        self.thread.start()

    def _watch(self) -> None:
        while self.running:
            status = Path("/proc/self/status").read_text()
            fields = dict(line.split(":", 1) for line in status.splitlines())
            self.largest = max(self.largest, int(fields["RssAnon"].split()[0]) / 1e3)
            time.sleep(0.01)

    def stop(self) -> float:
        self.running = False
        self.thread.join()
        return self.largest


def measure(root: Path, in_memory: bool = False) -> dict:
    """Load a dataset, and draw windows; optionally from a copy in memory too."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)

    def rate(episodes) -> float:
        began = time.perf_counter()
        for _ in range(DRAWS):
            sample_windows(episodes, WINDOWS, STEPS, generator)
        return DRAWS * WINDOWS / (time.perf_counter() - began)

    watch, began = Watch(), time.perf_counter()
    episodes = load_demonstrations(root)[0]["train"]
    row = {"load_s": time.perf_counter() - began}
    episodes = episodes.select("pixels", "action", "goal", "dynamics", "expert_action")
    row |= {
        "first_windows_per_s": rate(episodes),
        "windows_per_s": rate(episodes),
        "private_MB": watch.stop(),
    }
    if in_memory:
        copy = episodes.clone()
        rate(copy)
        row["windows_per_s_in_memory"] = rate(copy)
    return row


def in_process(*arguments) -> dict:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measure, *arguments).result()


def run(source: Path, folder: Path, count: int, enlarge: bool = False, in_memory: bool = False) -> dict:
    """Measure a dataset of ``count`` episodes, cold and warm, and delete it."""
    root = folder / f"{count}{'_enlarged' * enlarge}"
    tile(source, root, count, enlarge)
    size = sum(path.stat().st_size for path in root.rglob("*.parquet"))
    row = {
        "episodes": count,
        "files_MB": size / 1e6,
        "cold": in_process(root),
        "warm": in_process(root, in_memory),
    }
    cache = root.with_name(f"{root.name}.cache")
    row["cache_MB"] = sum(path.stat().st_size for path in cache.rglob("*") if path.is_file()) / 1e6
    for path in (root, cache):
        shutil.rmtree(path)
    return row


def draw(rows: dict[str, dict], path: Path) -> None:
    """Draw memory against the number of episodes."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = [row for name, row in rows.items() if name.isdigit()]
    episodes = [row["episodes"] for row in rows]
    figure, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    axes.loglog(
        episodes, [row["cache_MB"] for row in rows], "s--", color="gray", label="decoded frames, on disk"
    )
    axes.loglog(
        episodes, [row["cold"]["private_MB"] for row in rows], "o-", label="private memory, first load"
    )
    axes.loglog(
        episodes, [row["warm"]["private_MB"] for row in rows], "o-", label="private memory, later loads"
    )
    axes.set(xlabel="episodes", ylabel="MB", ylim=(100, None))
    axes.set_xticks(episodes, [f"{count:,}" for count in episodes])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--dataset", type=Path, default=Path("datasets/balance_reaching"))
    parser.add_argument("--episodes", default="350,1000,10000")
    parser.add_argument(
        "--two_cameras", type=int, default=350, help="episodes of the row of two cameras; 0 for none"
    )
    parser.add_argument("--folder", type=Path, help="folder for the datasets; by default a temporary one")
    parser.add_argument("--output", type=Path, default=RESULT)
    parser.add_argument("--draw", action="store_true", help="write the figure alone")
    options = parser.parse_args()
    if options.draw:
        return draw(read_json(options.output)["rows"], FIGURE)
    rows = {}
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        counts = [int(count) for count in options.episodes.split(",")]
        for count in counts:
            rows[str(count)] = run(options.dataset, Path(folder), count, in_memory=count == min(counts))
            print(count, rows[str(count)], flush=True)
        if options.two_cameras:
            rows["two_cameras"] = run(options.dataset, Path(folder), options.two_cameras, enlarge=True)
            print("two_cameras", rows["two_cameras"], flush=True)
    write_json(options.output, {"rows": rows, "command": command_line(sys.argv), "commit": find_commit()})
    return draw(rows, FIGURE)


if __name__ == "__main__":
    main()
