"""The commit of the code, for results."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]


@cache
def find_commit(root: Path = ROOT) -> str | None:
    """Return the commit of a checkout, with ``-dirty`` where Python files differ from it; None outside of a checkout.

    A process asks once: a commit that is made while a recipe runs is not that of its code.

    Args:
        root: top folder of the checkout, by default the one that this package is imported from.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != root.resolve():
            return None  # installed inside of another project's checkout
        return git("rev-parse", "--short=12", "HEAD") + (
            "-dirty" if git("status", "--short", "--", "*.py") else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return None
