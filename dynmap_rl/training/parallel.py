"""The parts of a batch, each differentiated in a thread of its own.

Threads that share every operation wait for each other hundreds of times an update; with a part each they meet once. On two free
cores that takes as long, but where another program takes one of them, a third less; and as there are as many parts whatever
the number of threads, one thread gives the same weights as two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from torch import nn

PARTS = 2  # on a CPU
Map = Callable[[Callable, Sequence], Iterator]


def split_batch(size: int, device: torch.device) -> list[int]:
    """The sizes of a batch's parts: halves on a CPU, the whole on a GPU."""
    parts = min(size, PARTS) if device.type == "cpu" else 1
    return [size // parts + (part < size % parts) for part in range(parts)]


@contextmanager
def map_in_threads(count: int) -> Iterator[Map]:
    """A ``map`` that works in up to ``count`` threads, no more than torch's, which they share; with one, here."""
    threads = torch.get_num_threads()
    if min(count, threads) == 1:
        yield map
        return
    share = threads // min(count, threads)
    try:
        with ThreadPoolExecutor(min(count, threads), "part", torch.set_num_threads, (share,)) as pool:
            yield pool.map
    finally:
        torch.set_num_threads(
            threads
        )  # of the libraries behind it, which the threads' own calls have changed


def differentiate(
    losses: Callable[[int], Mapping[str, torch.Tensor]],
    parts: Sequence[int],
    parameters: Sequence[nn.Parameter],
    map_parts: Map = map,
) -> dict[str, torch.Tensor]:
    """Sums over the parts: of their losses, which are returned, and of the gradients, which are left in ``grad``.

    Args:
        losses: a part's losses by name, of which the sum is differentiated; already weighted by the part's share.
        parts: what ``losses`` is called with.
        parameters: those that no part depends on get no gradient.
        map_parts: of :func:`map_in_threads`.
    """

    def work(part: int):
        found = losses(part)
        gradients = torch.autograd.grad(sum(found.values()), parameters, allow_unused=True)
        return {name: value.detach() for name, value in found.items()}, gradients

    found, gradients = zip(*map_parts(work, parts), strict=True)
    for parameter, *of_parts in zip(parameters, *gradients, strict=True):
        of_parts = [g for g in of_parts if g is not None]
        # In the parameter's own memory format, which fused optimisers take for granted.
        parameter.grad = torch.zeros_like(parameter) if of_parts else None
        for gradient in of_parts:
            parameter.grad += gradient
    return {name: sum(f[name] for f in found) for name in found[0]}
