"""What a user waits for before anything happens: an import, and a recipe's ``--help``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from timing import compare, seconds

RECIPES = Path(__file__).parents[2] / "recipes"


def _run(*arguments: str) -> float:
    command = [sys.executable, *arguments]
    return seconds(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))


def import_package() -> dict:
    """Seconds for ``import dynmap_rl`` against ``import gymnasium``, with which its ids are registered."""
    return compare(lambda: _run("-c", "import dynmap_rl"), lambda: _run("-c", "import gymnasium"))


def show_help(pattern: str = "*.py") -> dict:
    """Seconds for the slowest recipe's ``--help``, against ``import torch``."""
    recipes = sorted(map(str, RECIPES.glob(pattern)))
    slowest = max(recipes, key=lambda recipe: min(_run(recipe, "--help") for _ in range(2)))
    return compare(lambda: _run(slowest, "--help"), lambda: _run("-c", "import torch"), repeats=5)
