"""Training by several processes (ranks) on a Ray cluster, by Ray Train."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial

from .cluster import connect, lost
from .ranks import DIED, TIMEOUT

# Environment variables that a training's processes take over from the command.
VARIABLES = "HF_HOME", "HF_HUB_OFFLINE", "THP_MEM_ALLOC_ENABLE", "TQDM_DISABLE"


def train_by_ray(main: Callable, config, argv: list[str]) -> None:
    """Call a recipe's ``main(config)`` in several processes (ranks) of a Ray cluster, which train together.

    Without a cluster, Ray starts one on this machine. The machines of a cluster must share the working directory. What
    the first rank prints is printed here.

    Args:
        main: the recipe, which joins the ranks with :func:`dynmap_rl.utils.ranks.join_ranks`.
        config: its settings; ``compute`` is a :class:`dynmap_rl.utils.devices.RankedCompute`.
        argv: command line that the processes take over.

    Raises:
        ValueError: the cluster is too small.
        OSError: a process died.
    """
    import ray
    from ray.train import RunConfig, ScalingConfig
    from ray.train.torch import TorchConfig, TorchTrainer
    from ray.util.queue import Queue

    connect()
    compute = config.compute
    gpus = ray.cluster_resources().get("GPU", 0)
    gpu = compute.device == "cuda" or (compute.device == "auto" and gpus >= compute.ranks)
    each = {"CPU": compute.threads} | ({"GPU": 1} if gpu else {})
    _check_room(compute.ranks, each)
    local = replace(compute, device="cuda" if gpu else "cpu", launcher="local", ranks=1)
    variables = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    variables["RAY_TRAIN_ENABLE_PRINT_PATCH"] = "0"  # Ray Train would print everything twice
    output, errors = Queue(), []
    with tempfile.TemporaryDirectory() as storage:
        trainer = TorchTrainer(
            partial(_run_rank, main, replace(config, compute=local), os.getcwd(), argv, output),
            torch_config=TorchConfig(timeout_s=int(TIMEOUT.total_seconds())),
            scaling_config=ScalingConfig(num_workers=compute.ranks, use_gpu=gpu, resources_per_worker=each),
            run_config=RunConfig(storage_path=storage, worker_runtime_env={"env_vars": variables}),
        )

        def fit() -> None:
            try:
                trainer.fit()
            except Exception as error:
                errors.append(error)
            output.put(None)

        # In the main thread, Ray Train would end the process with exit code 0 on Ctrl-C.
        threading.Thread(target=fit, daemon=True).start()
        try:
            while item := output.get():
                name, text = item
                print(text, end="", file=getattr(sys, name), flush=True)
        except KeyboardInterrupt:
            ray.shutdown()  # ends the ranks
            raise
    for error in errors:
        raise _find_cause(error) from error


def _check_room(ranks: int, each: dict[str, int]) -> None:
    """Raise ``ValueError`` where Ray would wait forever for more machines."""
    import ray

    machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    room = sum(int(min(machine.get(name, 0) // each[name] for name in each)) for machine in machines)
    if room < ranks:
        needs = " and ".join(f"{number} {name}" for name, number in each.items())
        raise ValueError(
            f"--compute.ranks must be at most {room}, got {ranks}: the Ray cluster has no more room for ranks with "
            f"{needs} each; reduce --compute.ranks or --compute.threads"
        )


def _find_cause(error: Exception) -> Exception:
    """Return the error that a rank raised, or ``OSError`` where its process died."""
    failures = getattr(error, "worker_failures", {0: error}).values()
    for failure in failures:
        if not type(failure).__module__.startswith("ray.") and DIED not in str(failure):
            return failure
    return lost(error)


def _run_rank(main: Callable, config, folder: str, argv: list[str], output) -> None:
    os.chdir(folder)
    sys.argv = argv
    if os.environ["RANK"] != "0":
        main(config)
        return
    with redirect_stdout(_Stream(output, "stdout")), redirect_stderr(_Stream(output, "stderr")):
        main(config)


class _Stream(io.TextIOBase):
    """Stream of text to the process that started the training."""

    def __init__(self, queue, name: str):
        self.queue, self.name = queue, name

    def write(self, text: str) -> int:
        self.queue.put((self.name, text))
        return len(text)
