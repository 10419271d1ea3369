"""Every public name says what it is: modules, their classes and functions, and the methods that others may call."""

import importlib
import inspect
import pkgutil

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
