"""Several processes (ranks) that train one model, started by ``torchrun`` or Ray Train. Otherwise, there is one rank, 0.

Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Iterator
from datetime import timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

DIED = "another process of the run has ended; the same command resumes"
TIMEOUT = timedelta(days=1)  # the first rank may record a dataset, or evaluate, while the others wait


def join_ranks(device: str = "auto") -> None:
    """Join the other processes of ``torchrun`` or Ray Train; do nothing where there are none.

    On GPUs, which NCCL connects, every process takes its own; processors are connected by Gloo.

    Args:
        device: see :func:`dynmap_rl.utils.devices.choose_device`.

    Raises:
        ValueError: there are fewer GPUs than processes.
    """
    if int(os.environ.get("WORLD_SIZE", 1)) == 1:
        return
    import torch
    from torch import distributed

    from .devices import choose_device

    if distributed.is_initialized():  # Ray Train has joined them
        return
    gpu = choose_device(device).type == "cuda"
    if gpu:
        here = int(os.environ["LOCAL_WORLD_SIZE"])
        if here > torch.cuda.device_count():
            raise ValueError(
                f"{here} processes need as many GPUs, got {torch.cuda.device_count()}; add --compute.device cpu"
            )
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(f"error: {DIED}"))  # torchrun ends the others
    distributed.init_process_group("nccl" if gpu else "gloo", timeout=TIMEOUT)


def leave_ranks() -> int:
    """Leave the other processes, and return this process's rank; the first rank goes on alone."""
    number = rank()
    if ranks() > 1:
        from torch import distributed

        with translate_errors():
            distributed.barrier()
        distributed.destroy_process_group()
    return number


def ranks() -> int:
    """Return the number of processes that train together."""
    return _ask("get_world_size", 1)


def rank() -> int:
    """Return the number of this process; the first, 0, writes files."""
    return _ask("get_rank", 0)


def _ask(name: str, alone: int) -> int:
    if "torch" not in sys.modules:
        return alone
    from torch import distributed

    joined = distributed.is_available() and distributed.is_initialized()
    return getattr(distributed, name)() if joined else alone


@contextlib.contextmanager
def first_rank_first() -> Iterator[None]:
    """Run the block in the first process, then in the others."""
    with translate_errors():
        if rank():
            _wait()
        yield
        if not rank():
            _wait()


def _wait() -> None:
    if ranks() > 1:
        from torch import distributed

        distributed.barrier()


@contextlib.contextmanager
def translate_errors() -> Iterator[None]:
    """Raise ``OSError`` in the place of an error that the end of another process causes."""
    try:
        yield
    except RuntimeError as error:
        if ranks() > 1 and any(word in str(error) for word in ("gloo", "NCCL", "Connection")):
            raise OSError(DIED) from error
        raise


def mean_over_ranks(values: torch.Tensor) -> torch.Tensor:
    """Return the mean of a tensor over all processes, without a gradient; all of them must call it."""
    if ranks() == 1:
        return values
    from torch import distributed

    values = values.detach().clone()
    distributed.all_reduce(values)
    return values / ranks()
