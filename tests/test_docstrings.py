"""Every public name says what it is: modules, their classes and functions, and the methods that others may call."""

import ast
import importlib
import inspect
import pkgutil
from pathlib import Path

import pytest

import dynmap_rl

MODULES = [
    m.name for m in pkgutil.walk_packages(dynmap_rl.__path__, "dynmap_rl.") if "lerobot_policy_" not in m.name
]
THEIRS = ("dynmap_rl.integrations.lerobot.",)  # LeRobot calls their methods, and says what they are


def undocumented(module):
    if not inspect.getdoc(module):
        yield module.__name__
    for name, item in vars(module).items():
        own = getattr(item, "__module__", None) == module.__name__
        if name.startswith("_") or not own or not (inspect.isclass(item) or inspect.isfunction(item)):
            continue
        said = vars(item).get("__doc__") if inspect.isclass(item) else item.__doc__
        if not said or said.startswith(f"{name}("):  # which a dataclass says of itself
            yield name
        if inspect.isclass(item) and not module.__name__.startswith(THEIRS):
            for member, value in vars(item).items():
                kinds = property | classmethod | staticmethod
                public = not member.startswith("_") and (
                    inspect.isfunction(value) or isinstance(value, kinds)
                )
                if public and member != "forward" and not inspect.getdoc(getattr(item, member)):
                    yield f"{name}.{member}"


@pytest.mark.parametrize("name", MODULES)
def test_public_names_are_documented(name):
    if name.startswith("dynmap_rl.integrations"):
        pytest.importorskip("accelerate")
    assert list(undocumented(importlib.import_module(name))) == []


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[1] / "recipes").glob("*.py")), ids=lambda path: path.stem
)
def test_every_option_has_its_own_help(path):
    """``--help`` shows the comment above a field, so that one comment for several is shown for the first alone."""
    source = path.read_text()
    [config] = [
        node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == "Config"
    ]
    fields = [node for node in config.body if isinstance(node, ast.AnnAssign)]
    before = [source.splitlines()[field.lineno - 2].strip() for field in fields]
    assert [
        field.target.id for field, line in zip(fields, before, strict=True) if not line.startswith("#")
    ] == []
