"""Run folders: settings, metrics and training state, written so that a kill at any moment loses nothing.

A run folder holds ``config.json``, ``metrics.jsonl`` (one JSON object a line), ``checkpoint/`` and the results.
The same command on the same folder resumes it. Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import multiprocessing
import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


def run_processes(stages: Sequence[Callable[[tuple], None]], arguments: list[tuple], count: int) -> None:
    """Every stage of each argument, ``count`` at a time, each in a process of its own; one at a time, or one alone, in
    this one. A stage waits until the one before is done for this argument, and for the first stages of all.

    Raises:
        OSError: a process died.
    """
    if min(count, len(arguments)) <= 1:
        for one in arguments:
            for stage in stages:
                stage(one)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(count, mp_context=context, initializer=start_worker) as pool:
        try:
            running = {pool.submit(stages[0], one): (one, stages[1:]) for one in arguments}
            while running:
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    one, later = running.pop(future)
                    future.result()
                    if later:
                        running[pool.submit(later[0], one)] = one, later[1:]
        except BrokenProcessPool as error:
            raise OSError("a process died (of memory?); the same command goes on") from error
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def start_worker() -> None:
    """End at once and without a word on Ctrl-C, and when the parent ends, even if it is killed."""
    from tqdm import tqdm

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which Python would report as leaked
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def run_script(script: Path, arguments: list[str], folder: Path, log: Path) -> int:
    """``python SCRIPT ARGUMENTS`` in a folder, what it prints added to ``log``, in a process of its own; its exit code.

    It ends with this process, even if this is killed.
    """
    arguments = str(script), arguments, folder, log
    process = multiprocessing.get_context("spawn").Process(target=_run_here, args=arguments)
    process.start()
    while process.exitcode is None:  # join alone may miss it where another thread starts a process
        process.join()
    return process.exitcode


def _run_here(script: str, arguments: list[str], folder: Path, log: Path) -> None:
    from .processes import start_worker

    start_worker()
    with open(log, "a") as file:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(file.fileno(), stream.fileno())
    os.chdir(folder)
    sys.argv = [script, *arguments]
    runpy.run_path(script, run_name="__main__")
