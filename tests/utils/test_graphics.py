"""A ``MUJOCO_GL`` that cannot be loaded: one line, whatever imports TorchRL or MuJoCo first."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from own_task import check_renderer

pytest.importorskip("mujoco", reason="uv pip install -e '.[mujoco]'")

ROOT = Path(__file__).parents[2]
GET_TASK = "from dynmap_rl.envs.tasks import get_task; get_task('mujoco:FetchPush')"
PYTEST = "-m", "pytest", "-n", "0", "--collect-only", "tests/utils/test_version.py"


def run(renderer, *arguments):
    # With a platform of OpenGL that contradicts it, osmesa fails as where its library is missing.
    env = os.environ | {"MUJOCO_GL": renderer, "PYOPENGL_PLATFORM": "egl"}
    command = sys.executable, *arguments
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("renderer", ["osmesa", "nothing"])
def test_recipes_of_all_tasks_name_the_renderer_in_one_line(renderer):
    result = run(renderer, "recipes/evaluate.py", "--expert", "balance_reaching", "--eval.episodes", "2")
    assert result.returncode == 2 and result.stderr.count("\n") == 1
    assert result.stderr.startswith(
        f"error: MUJOCO_GL must be a renderer that can be loaded here, got {renderer} ("
    )
    assert "libosmesa6" in result.stderr and "unset MUJOCO_GL" in result.stderr
    assert run(renderer, "recipes/evaluate.py", "--help").returncode == 0


@pytest.mark.parametrize(
    ("arguments", "code"), [(("-c", GET_TASK), 1), (PYTEST, 4)], ids=["get_task", "pytest"]
)
def test_python_and_tests_name_the_renderer(arguments, code):
    result = run("osmesa", *arguments)
    assert result.returncode == code
    assert "MUJOCO_GL must be a renderer" in result.stderr.strip().splitlines()[-1]


def test_ci_fails_where_nothing_can_be_drawn():
    code = re.search(r'python -c "(.*)"', (ROOT / ".ci/run").read_text())[1]
    assert run("osmesa", "-c", code).returncode == 1
    check_renderer()
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
