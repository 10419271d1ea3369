"""Measure updates of a world model: frames a second by size of the batch, and what an update spends its time on.

    python tests/benchmarks/updates.py                                        # the sizes of this machine
    python tests/benchmarks/updates.py --device cuda --windows 16,64,256,1024 --compile
    python tests/benchmarks/updates.py --windows 2,4 --updates 1              # a trial

Every batch has windows of 24 steps of random frames; as many frames are decoded for a window as in
``recipes/decoupled.py``. ``convolution_peak`` is the rate of the fastest of a few large convolutions in the same
precision; the share of an update is its own floating-point operations (convolutions and products, forward and backward,
LSTMs on a GPU excluded) at that rate, divided by its time. Writes ``recipes/results/measurements/updates_DEVICE.json``.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import Counter
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import nn
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from dynmap_rl.data.augmentation import augment
from dynmap_rl.data.windows import sample_windows
from dynmap_rl.keys import DYNAMICS
from dynmap_rl.modules.checkpoints import make_world_model
from dynmap_rl.modules.precision import mixed_precision
from dynmap_rl.training.loop import make_optimizer, step
from dynmap_rl.training.settings import WorldModelTraining
from dynmap_rl.training.world_model import make_loss
from dynmap_rl.utils.cli import command_line
from dynmap_rl.utils.devices import choose_device
from dynmap_rl.utils.files import write_json
from dynmap_rl.utils.version import find_commit

RESULTS = Path(__file__).parents[2] / "recipes/results/measurements"
STEPS, DECODED = 24, 6  # steps of a window, and frames decoded of it
RANGES = {"action": 3, "goal": 2, **dict.fromkeys(DYNAMICS, 6)}
CONSTANTS = {name: {"low": [-1.0] * size, "high": [1.0] * size} for name, size in RANGES.items()}
SHAPES = (64, 64, 32), (64, 128, 16), (256, 64, 32)  # batch, channels and side of the large convolutions
FAMILIES = {
    "convolution": ("convolution",),
    "product": ("mm", "addmm", "bmm", "baddbmm", "matmul"),
    "LSTM": ("lstm", "rnn", "lstm_cell", "mkldnn_rnn"),
    "normalisation": ("layer_norm", "softmax"),
    "copy": (
        "copy_",
        "clone",
        "contiguous",
        "cat",
        "_to_copy",
        "fill_",
        "zero_",
        "index_select",
        "gather",
        "scatter",
    ),
    "optimiser": ("_fused_adamw", "_foreach_norm", "linalg_vector_norm", "_foreach_mul"),
}


def make_episodes(count: int = 32, steps: int = 48) -> TensorDict:
    """Return random episodes ``[count, steps]``."""
    values = {
        "pixels": torch.randint(0, 256, (count, steps, 3, 64, 64), dtype=torch.uint8),
        "action": torch.rand(count, steps, 3),
        "goal": torch.rand(count, steps, 2),
        "dynamics": {name: torch.rand(count, steps, 6) for name in DYNAMICS},
    }
    return TensorDict(values, [count, steps])


class Update:
    """One update after the other, as :func:`dynmap_rl.training.loop.fit` takes them."""

    def __init__(self, device: torch.device, windows: int, mixed: bool, compiled: bool):
        torch.manual_seed(0)
        self.settings = WorldModelTraining(windows=windows, rgb_frames=DECODED * windows, short_windows=0)
        self.device, self.mixed = device, mixed
        model = make_world_model(CONSTANTS, ("position", "velocity")).to(
            device, memory_format=torch.channels_last
        )
        if compiled:  # a module with an LSTM does not compile
            model.encoder.compile()
            model.image_decoder.compile()
        self.generator = torch.Generator(device).manual_seed(0)
        self.loss = make_loss(model, self.settings, self.generator)
        self.optimizer = make_optimizer(model, 1e-4, 1e-4)
        self.episodes = make_episodes().to(device)

    def draw(self) -> TensorDict:
        windows = sample_windows(self.episodes, self.settings.windows, STEPS, self.generator)
        return augment(windows, self.generator, self.settings.augmentation)

    def learn(self, windows: TensorDict) -> None:
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.mixed, cache_enabled=False):
            losses = self.loss(windows)
        step(sum(losses.values()), self.optimizer)

    def __call__(self) -> None:
        self.learn(self.draw())


def seconds(device: torch.device, work, repeats: int) -> float:
    """Return the median time of a call."""
    times = []
    for number in range(repeats + 2):
        if device.type == "cuda":
            torch.cuda.synchronize()
        began = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize()
        if number >= 2:  # the first ones are slower
            times.append(time.perf_counter() - began)
    return statistics.median(times)


def convolution_peak(device: torch.device, mixed: bool, repeats: int) -> float:
    """Return the largest rate of a 3 x 3 convolution (floating-point operations a second)."""
    dtype, rates = torch.bfloat16 if mixed else torch.float32, []
    for batch, channels, side in SHAPES:
        layer = nn.Conv2d(channels, channels, 3, padding=1).to(
            device, dtype, memory_format=torch.channels_last
        )
        x = torch.randn(batch, channels, side, side, device=device, dtype=dtype)
        x = x.to(memory_format=torch.channels_last)
        with torch.no_grad():
            took = seconds(device, lambda layer=layer, x=x: layer(x), repeats)
        rates.append(2 * 9 * channels**2 * side**2 * batch / took)
    return max(rates)


def break_down(update: Update, repeats: int) -> dict[str, float]:
    """Return shares of the operators' time in an update, by family."""
    gpu = update.device.type == "cuda"
    with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if gpu else [])]) as found:
        for _ in range(repeats):
            update()
    times = Counter()
    for event in found.key_averages():
        name = event.key.removeprefix("aten::")
        spent = event.self_device_time_total if gpu else event.self_cpu_time_total
        family = (
            key
            for key, words in FAMILIES.items()
            if name in words or any(w in name for w in words if len(w) > 5)
        )
        times[next(family, "other")] += spent
    total = sum(times.values())
    return {name: spent / total for name, spent in times.most_common()}


def measure(
    device: torch.device, windows: int, mixed: bool, compiled: bool, repeats: int, peak: float
) -> dict:
    """Measure updates of batches of ``windows`` windows."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    update = Update(device, windows, mixed, compiled)
    took, batch = seconds(device, update, repeats), update.draw()
    row = {"windows": windows, "mixed": mixed, "compiled": compiled, "ms": 1000 * took}
    row |= {
        "frames_per_s": windows * STEPS / took,
        "drawing_ms": 1000 * seconds(device, update.draw, repeats),
    }
    if device.type == "cuda":
        row["memory_MB"] = torch.cuda.max_memory_allocated() / 1e6
    if not compiled:
        with FlopCounterMode(display=False) as counter:
            update.learn(batch)
        row["share_of_convolution_peak"] = counter.get_total_flops() / took / peak
        row["breakdown"] = break_down(update, min(repeats, 5))
    return row


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--windows", help="by default 4,12 on a CPU, and 16,64,256,1024 on a GPU")
    parser.add_argument("--updates", type=int, default=10, help="updates timed for a row")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--compile", action="store_true", help="also with torch.compile")
    parser.add_argument("--output", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = choose_device(options.device)
    precisions = sorted({False, mixed_precision(device)._enabled})
    sizes = options.windows or ("16,64,256,1024" if device.type == "cuda" else "4,12")
    rows, peaks = [], {}
    for mixed in precisions:
        peak = convolution_peak(device, mixed, options.updates)
        peaks["bfloat16" if mixed else "float32"] = peak
        for windows in map(int, sizes.split(",")):
            for compiled in (False, True)[: 1 + options.compile]:
                rows.append(measure(device, windows, mixed, compiled, options.updates, peak))
                print(rows[-1], flush=True)
    name = torch.cuda.get_device_name() if device.type == "cuda" else f"{options.threads} threads"
    result = {"device": name, "threads": options.threads, "convolution_peak_flops": peaks, "rows": rows}
    result |= {"command": command_line(sys.argv), "commit": find_commit()}
    write_json(options.output or RESULTS / f"updates_{device.type}.json", result)


if __name__ == "__main__":
    main()
