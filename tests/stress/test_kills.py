"""Recipes that are killed at random moments; ``python tests/stress/kills.py`` kills each 20 times."""

import random
import sys

import pytest
from stress import kills

pytestmark = [pytest.mark.stress, pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")]


@pytest.mark.parametrize("recipe", kills.COMMANDS)
def test_a_killed_recipe_resumes_to_the_same_files(tmp_path, recipe):
    random.seed(0)
    assert kills.torment(recipe, 3, tmp_path)["files_the_same"] > 3
