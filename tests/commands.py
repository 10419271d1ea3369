"""Run recipes as commands, but in the tests' own process, since another process would import everything again."""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import subprocess
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest
import torch

from dynmap_rl.utils.cli import list_options, run_recipe

BROWSER = Path(__file__).with_name("browser.py")
PRESETS = Path(__file__).with_name("presets")
RECIPES = Path(__file__).parents[1] / "recipes"


def run(folder: Path, recipe: str, *arguments: str) -> CompletedProcess:
    """Run ``python recipes/RECIPE.py ARGUMENTS`` in a folder and return exit code and output.

    Recipes of ``recipes/paper`` are named with or without that folder.
    """
    file = next(
        path for path in (RECIPES / f"{recipe}.py", RECIPES / "paper" / f"{recipe}.py") if path.exists()
    )
    module = importlib.import_module(".".join(file.relative_to(RECIPES.parent).with_suffix("").parts))
    out, err, threads, code = io.StringIO(), io.StringIO(), torch.get_num_threads(), 0
    argv = [str(file), *map(str, arguments)]
    if "--compute.threads" in list_options(module.Config) and "--compute.threads" not in argv:
        argv += ["--compute.threads", "1"]  # the tests themselves run in parallel
    try:
        with (
            contextlib.chdir(folder),
            pytest.MonkeyPatch.context() as patch,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            patch.setattr(sys, "argv", argv)
            patch.setattr(sys, "path", [*sys.path])
            run_recipe(module.main, module.Config, argv)
    except SystemExit as end:
        code = end.code
        if isinstance(code, str):
            code = print(code, file=err) or 1
    finally:
        torch.set_num_threads(threads)
    return CompletedProcess([recipe, *arguments], code or 0, out.getvalue(), err.getvalue())


def run_small(folder: Path, recipe: str, *arguments: str, pictures: bool = False) -> CompletedProcess:
    """Run a recipe with its preset, every stage in a minimal size; the command must succeed.

    Figures and animations would take half of the time; without ``pictures`` they are left out.
    """
    drawing = (
        "dynmap_rl.reporting.run_page._draw",
        "dynmap_rl.reporting.media.film",
        "recipes.latent_ppo.film",
    )
    with pytest.MonkeyPatch.context() as patch:
        for function in () if pictures else drawing:
            patch.setattr(function, lambda *arguments, **options: None)
        result = run(folder, recipe, "--config_path", PRESETS / f"{recipe}.yaml", *arguments)
    assert result.returncode == 0, result.stderr
    return result


def place_recordings(folder: Path, recordings, *tasks: str) -> None:
    """Link the tests' shared recordings to where recipes look for their datasets."""
    (folder / "datasets").mkdir(exist_ok=True)
    for task in tasks:
        (folder / "datasets" / task).symlink_to(recordings(task), target_is_directory=True)


def open_in_browser(page: Path, picture: Path) -> dict:
    """Return what ``browser.py`` found in a page; skip the test where there is no browser."""
    command = [sys.executable, BROWSER, page, picture]
    result = subprocess.run(command, capture_output=True, text=True, timeout=200)
    if "ModuleNotFoundError" in result.stderr or "cannot open shared object file" in result.stderr:
        pytest.skip(f"uv pip install -e '.[browser]' and its libraries: {result.stderr.splitlines()[-1]}")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)
