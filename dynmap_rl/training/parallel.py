"""Gradients of the parts of a batch, each in a thread of its own.

Threads that share every operation wait for each other hundreds of times an update; threads with a part of the batch
each wait once. There are as many parts with any number of threads, so that the weights do not depend on it.
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
    """Return the sizes of a batch's parts: halves on a CPU, the whole batch on a GPU."""
    parts = min(size, PARTS) if device.type == "cpu" else 1
    return [size // parts + (part < size % parts) for part in range(parts)]


@contextmanager
def map_in_threads(count: int) -> Iterator[Map]:
    """Yield a ``map`` that works in up to ``count`` threads, which share torch's threads."""
    threads = torch.get_num_threads()
    if min(count, threads) == 1:
        yield map
        return
    share = threads // min(count, threads)
    try:
        with ThreadPoolExecutor(min(count, threads), "part", torch.set_num_threads, (share,)) as pool:
            yield pool.map
    finally:
        torch.set_num_threads(threads)  # the threads' own calls have changed the libraries' setting


def differentiate(
    losses: Callable[[int], Mapping[str, torch.Tensor]],
    parts: Sequence[int],
    parameters: Sequence[nn.Parameter],
    map_parts: Map = map,
) -> dict[str, torch.Tensor]:
    """Sum losses and gradients over the parts of a batch.

    Args:
        losses: function from a part to its losses by name, weighted by the part's share; their sum is differentiated.
        parts: arguments of ``losses``.
        parameters: get the sum of the gradients in ``grad``, or None where no part depends on them.
        map_parts: see :func:`map_in_threads`.

    Returns:
        The summed losses by name, detached.
    """

    def work(part: int):
        found = losses(part)
        gradients = torch.autograd.grad(sum(found.values()), parameters, allow_unused=True)
        return {name: value.detach() for name, value in found.items()}, gradients

    found, gradients = zip(*map_parts(work, parts), strict=True)
    for parameter, *of_parts in zip(parameters, *gradients, strict=True):
        of_parts = [g for g in of_parts if g is not None]
        # In the parameter's own memory format, which fused optimisers require.
        parameter.grad = torch.zeros_like(parameter) if of_parts else None
        for gradient in of_parts:
            parameter.grad += gradient
    return {name: sum(f[name] for f in found) for name in found[0]}
