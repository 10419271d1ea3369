"""Options: each has its own help, and every preset fits its recipe."""

import ast
import importlib
import sys
from pathlib import Path

import pytest
from commands import PRESETS

from dynmap_rl.utils.cli import parse_settings

ROOT = Path(__file__).parents[2]
RECIPES = [path.relative_to(ROOT) for path in sorted((ROOT / "recipes").rglob("*.py"))]
SETTINGS = [
    Path("dynmap_rl") / name
    for name in ("training/settings.py", "data/settings.py", "evaluation/settings.py", "utils/devices.py")
]


@pytest.mark.parametrize("path", RECIPES + SETTINGS, ids=str)
def test_every_option_has_its_own_help(path):
    """``--help`` shows the comment above a field; a comment above several would be shown for the first alone."""
    lines = (ROOT / path).read_text().splitlines()
    classes = [node for node in ast.parse("\n".join(lines)).body if isinstance(node, ast.ClassDef)]
    assert classes or path.parts[0] == "recipes"
    fields = [node for each in classes for node in each.body if isinstance(node, ast.AnnAssign)]
    assert [f.target.id for f in fields if not lines[f.lineno - 2].strip().startswith("#")] == []


@pytest.mark.parametrize("preset", sorted(PRESETS.glob("*.yaml")), ids=lambda path: path.stem)
def test_presets_fit_their_recipes(preset):
    config_class = importlib.import_module(f"recipes.{preset.stem.removesuffix('_pretrained')}").Config
    assert parse_settings(config_class, ["--config_path", str(preset)]) != config_class()


def test_importing_a_recipe_reads_no_arguments(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pytest", "--nonsense"])
    for path in RECIPES:
        importlib.import_module(".".join(path.with_suffix("").parts))
