"""The structure of the package: floors, one direction of imports, no circles."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "dynmap_rl"
FLOORS = (
    "utils", "modules", "envs", "objectives", "experts", "data", "runs", "evaluation", "training", "reporting",
    "paper", "integrations", "play",
)  # fmt: skip
BESIDE = [("integrations", "play"), ("play", "integrations")]  # neither stands on the other


def name_module(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {
    name_module(path): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if not path.parent.name.startswith(("lerobot_env_", "lerobot_policy_"))
}


def list_imports(name: str) -> set[str]:
    """Modules of the package that a module imports, at its top or in a function."""
    path, found = MODULES[name], set()
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            source = ".".join(part for part in (base, node.module) if part)
            members = {f"{source}.{alias.name}" for alias in node.names}
            found |= (members & MODULES.keys()) or {source}
    return {module for module in found if module in MODULES and module not in ("dynmap_rl", name)}


IMPORTS = {name: list_imports(name) for name in MODULES}


def floor(module: str) -> str:
    return module.split(".")[1]


@pytest.mark.parametrize("name", [name for name in MODULES if name.count(".") > 0])
def test_imports_lead_to_floors_on_the_left(name):
    if floor(name) == "keys":
        assert not IMPORTS[name]
        return
    allowed = {"keys", *FLOORS[: FLOORS.index(floor(name)) + 1]}
    targets = {floor(module) for module in IMPORTS[name]}
    assert targets <= allowed
    assert not any((floor(name), target) in BESIDE for target in targets)


def test_there_is_no_circle():
    try:
        TopologicalSorter(IMPORTS).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_only_recipes_and_tests_use_the_paper():
    assert not {name for name in MODULES if floor_or_root(name) != "paper" and uses_paper(name)}


def floor_or_root(module: str) -> str:
    return floor(module) if "." in module else "root"


def uses_paper(name: str) -> bool:
    return any(floor(module) == "paper" for module in IMPORTS[name])


def test_the_root_holds_no_other_module():
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "keys"}
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir()} - {"__pycache__"} == {
        *FLOORS,
        "pretrained",
    }
