"""Recipes as commands, but in the tests' own process: a process of their own would import everything again. And what a
browser makes of the pages that they write."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess
from unittest import mock

import pytest
import torch

from dynmap_rl.utils.cli import run_recipe

BROWSER = Path(__file__).with_name("browser.py")


def run(folder: Path, recipe: str, *arguments: str) -> CompletedProcess:
    """``python recipes/RECIPE.py ARGUMENTS`` in a folder: its exit code and what it printed."""
    module = importlib.import_module(f"recipes.{recipe}")
    out, err, threads, code = io.StringIO(), io.StringIO(), torch.get_num_threads(), 0
    try:
        with (
            contextlib.chdir(folder),
            mock.patch.object(sys, "argv", [module.__file__, *map(str, arguments)]),
            mock.patch.object(sys, "path", [*sys.path]),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            run_recipe(module.main, module.Config)
    except SystemExit as end:
        code = end.code
        if isinstance(code, str):
            code = print(code, file=err) or 1
    finally:
        torch.set_num_threads(threads)
    return CompletedProcess([recipe, *arguments], code or 0, out.getvalue(), err.getvalue())


def place_recordings(folder: Path, recordings, *tasks: str) -> None:
    """Where a smoke run looks for its datasets, the ones that the tests share."""
    (folder / "datasets").mkdir(exist_ok=True)
    for task in tasks:
        (folder / "datasets" / f"{task}_smoke").symlink_to(recordings(task), target_is_directory=True)


def open_in_browser(page: Path, picture: Path) -> dict:
    """What ``browser.py`` says of a page; the test is skipped where there is no browser."""
    command = [sys.executable, BROWSER, page, picture]
    result = subprocess.run(command, capture_output=True, text=True, timeout=200)
    if "ModuleNotFoundError" in result.stderr or "cannot open shared object file" in result.stderr:
        pytest.skip(f"pip install '.[browser]', and what it needs: {result.stderr.splitlines()[-1]}")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)
