"""Calls on the machines of a Ray cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec

LAUNCHERS = "local", "ray"


def check_launcher(launcher: str) -> None:
    """Raise ``ValueError`` for an unknown launcher, and for ``ray`` where Ray is not installed."""
    if launcher not in LAUNCHERS:
        raise ValueError(f"launcher must be one of {', '.join(LAUNCHERS)}, got {launcher!r}")
    if launcher == "ray" and find_spec("ray") is None:
        raise ValueError("launcher ray needs Ray: uv pip install -e '.[ray]'")


def connect() -> None:
    """Connect to the Ray cluster of ``RAY_ADDRESS``, or to one on this machine, started where there is none.

    Workers have the Python environment of the cluster, also under ``uv run``, where Ray would copy the working directory and
    install it once more for every worker. ``RAY_ENABLE_UV_RUN_RUNTIME_ENV=1`` asks for that.
    """
    import ray
    from ray._private import ray_constants  # TorchRL may have imported Ray, which reads the variable then

    if not ray.is_initialized():
        if "RAY_ENABLE_UV_RUN_RUNTIME_ENV" not in os.environ:
            ray_constants.RAY_ENABLE_UV_RUN_RUNTIME_ENV = False
        ray.init(log_to_driver=False, logging_level="ERROR")


def run_by_ray(function: Callable, arguments: Sequence) -> Iterator[tuple[object, Callable]]:
    """Call a function on Ray's workers, a CPU each, in the order in which they end.

    Without a cluster, Ray starts one on this machine. Folders of the arguments must be shared by its machines.

    Args:
        function: function of one argument.
        arguments: what the function is called with.

    Yields:
        The argument, and a function that returns the value, or raises what the call raised or ``OSError`` where its
        worker died.
    """
    import ray

    connect()
    remote = ray.remote(num_cpus=1, max_retries=0)(function)
    running = {remote.remote(one): one for one in arguments}
    try:
        while running:
            (done,), _ = ray.wait(list(running))
            yield running.pop(done), lambda done=done: _get(done)
    finally:
        for other in running:
            ray.cancel(other)


def _get(reference):
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except ray.exceptions.RayError as error:
        raise lost(error) from error


def lost(error: Exception) -> OSError:
    """Return the error of a worker that Ray lost."""
    return OSError(f"a worker was lost by Ray ({type(error).__name__}); the same command resumes")
