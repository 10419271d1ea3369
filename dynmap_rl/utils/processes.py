"""Work in processes of its own, which end with the process that started them."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path


def run_processes(stages: Sequence[Callable[[tuple], None]], arguments: list[tuple], count: int) -> None:
    """Run every stage on each argument, ``count`` at a time, each in a process of its own.

    A stage begins when the stage before it is done for its argument and the first stages of all arguments have
    started. With one process or one argument, everything runs in this process, whose number of torch's threads is
    restored.

    Args:
        stages: functions of one argument, in order.
        arguments: what the stages are called with.
        count: largest number of processes.

    Raises:
        OSError: a process died.
    """
    if min(count, len(arguments)) <= 1:
        import torch

        threads = torch.get_num_threads()
        try:
            for one in arguments:
                for stage in stages:
                    stage(one)
        finally:
            torch.set_num_threads(threads)
        return
    with open_pool(count, "the same command resumes") as pool:
        running = {pool.submit(stages[0], one): (one, stages[1:]) for one in arguments}
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                one, later = running.pop(future)
                if running and (error := future.exception()):
                    print(f"error: {error}; this ends when what runs beside it has ended", file=sys.stderr)
                future.result()
                if later:
                    running[pool.submit(later[0], one)] = one, later[1:]


@contextlib.contextmanager
def open_pool(count: int, advice: str) -> Iterator[ProcessPoolExecutor | None]:
    """Open a pool of processes until the end of the block; an error in the block cancels what has not begun.

    The pool is None where the number is not above 0.

    Args:
        count: number of processes.
        advice: what to do where a process dies, a part of the message.

    Raises:
        ChildProcessError: a process died.
    """
    if count < 1:
        yield None
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=start_worker) as pool:
        try:
            yield pool
        except BrokenProcessPool as error:
            raise ChildProcessError(f"a process died, perhaps for want of memory; {advice}") from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def map_processes(function: Callable, arguments: Sequence, count: int, title: str | None = None) -> list:
    """Return ``function(argument)`` for each argument, computed by this process and ``count - 1`` others.

    The others take from the front of the sequence and this process from its end, so that it works while they start.

    Args:
        function: picklable function.
        arguments: what the function is called with.
        count: number of processes.
        title: title of a progress bar.

    Raises:
        OSError: a process died.
    """
    from tqdm import tqdm

    bar = {} if title else {"disable": True}  # False would override TQDM_DISABLE
    with (
        tqdm(total=len(arguments), desc=title, leave=False, **bar) as progress,
        open_pool(min(count, len(arguments)) - 1, "use fewer threads") as pool,
    ):
        return share(pool, function, arguments, lambda argument: progress.update())


def share(
    pool: ProcessPoolExecutor | None,
    function: Callable,
    arguments: Sequence,
    done: Callable[[object], object] = lambda argument: None,
) -> list:
    """Return ``function(argument)`` for each argument, computed by the processes of a pool and by this one.

    Args:
        pool: see :func:`open_pool`; None leaves everything to this process.
        function: picklable function.
        arguments: what the function is called with. The pool takes from the front, and this process from the end.
        done: called with each argument when its value is there.
    """

    def call(argument):
        value = function(argument)
        done(argument)
        return value

    if pool is None:
        return [call(one) for one in arguments]
    *others, last = arguments  # a pool takes one more than it has processes, which cannot be taken back
    futures = [pool.submit(function, one) for one in others]
    own = [call(last)]
    own += [call(one) for one, future in zip(others[::-1], futures[::-1], strict=True) if future.cancel()]
    values = []
    for argument, future in zip(others, futures, strict=True):
        if future.cancelled():
            values.append(own.pop())
        else:
            values.append(future.result())
            done(argument)
    return values + own


def start_worker() -> None:
    """End this process silently on Ctrl-C, and when its parent ends, even by a kill."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    tqdm.set_lock(threading.RLock())  # tqdm's own lock is a semaphore, which Python would report as leaked
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def run_script(
    script: Path, arguments: list[str], folder: Path, log: Path, threads: int | None = None
) -> int:
    """Run ``python SCRIPT ARGUMENTS`` in a process of its own and return the exit code.

    Args:
        script: file to run.
        arguments: of the command line.
        folder: working directory.
        log: file to which the output is appended.
        threads: threads of torch, for a script without an option for them.
    """
    arguments = str(script), arguments, folder, log, threads
    process = multiprocessing.get_context("spawn").Process(target=_run_here, args=arguments)
    process.start()
    while process.exitcode is None:  # join alone may miss the end where another thread starts a process
        process.join()
    return process.exitcode


def _run_here(script: str, arguments: list[str], folder: Path, log: Path, threads: int | None) -> None:
    if threads:
        os.environ["OMP_NUM_THREADS"] = str(threads)  # before torch is imported
    os.environ.setdefault("TQDM_MININTERVAL", "30")  # s; every update of a bar would be a line of the file
    start_worker()
    with open(log, "a") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    os.chdir(folder)
    sys.argv = [script, *arguments]
    runpy.run_path(script, run_name="__main__")
