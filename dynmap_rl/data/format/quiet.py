"""Silence for LeRobot and datasets while they are imported and used."""

from __future__ import annotations

import contextlib
import io
import logging


@contextlib.contextmanager
def quiet():
    """Hold back progress bars and notes of LeRobot and datasets, such as the page on missing video decoders."""
    import datasets

    disabled, bars = logging.root.manager.disable, datasets.are_progress_bars_disabled()
    logging.disable(logging.WARNING)
    datasets.disable_progress_bars()
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            yield
    finally:
        logging.disable(disabled)
        if not bars:
            datasets.enable_progress_bars()
