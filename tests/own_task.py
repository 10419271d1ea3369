"""The task of the page of MuJoCo tasks, as a module ``my_tasks`` of its own."""

import importlib
import re
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "dynmap_rl/envs/mujoco/README.md"


def read_code() -> str:
    """Return the first Python snippet of the page."""
    return re.search(r"```python\n(.*?)```", PAGE.read_text(), re.S)[1]


@pytest.fixture(scope="module")
def own_task(tmp_path_factory):
    """Return the name of the task, where MuJoCo can draw."""
    check_renderer()
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_mujoco_tasks.py").write_text(read_code())
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        importlib.import_module("my_mujoco_tasks")
        yield "my_mujoco_tasks:Push"
    sys.modules.pop("my_mujoco_tasks", None)


def check_renderer() -> None:
    """Skip the test where MuJoCo is missing or cannot draw."""
    pytest.importorskip("mujoco", reason="uv pip install -e '.[mujoco]'")
    from dynmap_rl.envs.mujoco.rendering import make_canvas

    try:
        make_canvas(64).free()
    except OSError as error:
        pytest.skip(str(error))
