"""Recipes as commands: options, nested defaults, and errors in one line."""

import ast
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from dynmap_rl.utils.cli import MEMORY, command_line, parse_seeds, refuse, run_recipe
from dynmap_rl.utils.settings import check_at_least

PACKAGE = Path(__file__).parents[2] / "dynmap_rl"


@dataclass(frozen=True)
class Group:
    updates: int = 5
    # Some rate.
    rate: float = 0.1

    def __post_init__(self):
        check_at_least(self, 1, "updates")


@dataclass(frozen=True)
class Settings:
    steps: int = 3
    dry_run: bool = False
    output: Path | None = None
    color: str = "red"
    policy: str | None = None
    first: Group = Group()
    second: Group = Group(rate=0.5)


@pytest.fixture
def run(monkeypatch):
    """Return a function that runs a recipe and returns the settings that it got."""

    def run(*arguments, main=None):
        monkeypatch.setattr("sys.path", [*sys.path])
        got = []
        run_recipe(main or got.append, Settings, ["recipes/some.py", *arguments])
        return got[0]

    return run


@pytest.mark.parametrize("arguments", [["--dry-run"], ["--dry_run", "True"], ["--dry-run=true"]])
def test_options_with_hyphens_and_bare_flags(run, arguments):
    assert run(*arguments, "--steps=-4") == Settings(steps=-4, dry_run=True)


@pytest.mark.parametrize(
    "text", ["#1c1c1c", "2026-01-01", "yes", "0x1f", "a: b", "[1]", "~", 'it\'s "Ä"', "-1", ""]
)
def test_texts_are_taken_as_they_are_and_paths_but_for_the_home_folder(run, text):
    expected = Settings(color=text, output=Path(text).expanduser())
    assert run("--color", text, "--output", text) == expected
    assert run(f"--color={text}", f"--output={text}") == expected


def test_null_clears_an_option(run, tmp_path):
    (tmp_path / "file.yaml").write_text("output: here\n")
    assert run("--config_path", str(tmp_path / "file.yaml"), "--output", "null") == Settings()


def test_null_is_a_text_where_an_option_must_have_one(run):
    assert run("--color", "null") == Settings(color="null") == run("--color=null")


def test_a_nested_option_leaves_the_other_defaults_of_its_group(run):
    assert run("--second.updates", "7") == Settings(second=Group(7, 0.5))


@pytest.mark.parametrize("arguments", [("--output", "include_all"), ("--policy=include x",)])
def test_a_word_of_draccus_is_refused(run, capsys, arguments):
    with pytest.raises(SystemExit):
        run(*arguments)
    assert "./include" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--help", "-h"])
def test_the_help_shows_the_defaults_that_apply(run, capsys, option):
    with pytest.raises(SystemExit):
        run(option)
    lines = " ".join(capsys.readouterr().out.split())
    assert "--first.rate float Some rate. (default: 0.1)" in lines
    assert "--second.rate float Some rate. (default: 0.5)" in lines
    assert __doc__ in lines and "--debug" in lines


@pytest.mark.parametrize(
    "arguments", [("--policy", "run", "--help"), ("--help", "--policy", "run"), ("--policy", "run", "-h")]
)
def test_the_help_is_shown_beside_other_options(run, capsys, arguments):
    with pytest.raises(SystemExit) as stopped:
        run(*arguments)
    assert not stopped.value.code and capsys.readouterr().out.startswith("usage:")


def test_the_help_lists_no_option_that_is_refused(run, capsys):
    with pytest.raises(SystemExit):
        run("--help")
    for option in set(re.findall(r"--[a-z_.]+", capsys.readouterr().out)) - {"--help"}:
        value = [] if option == "--debug" else [""]
        try:
            run(option, *value)
        except SystemExit:
            assert "unknown option" not in capsys.readouterr().err


def test_a_file_of_settings_and_options_that_override_it(run, tmp_path):
    (tmp_path / "small.yaml").write_text("steps: 1\noutput: here\nsecond: {updates: 2}\n")
    expected = Settings(1, output=Path("here"), second=Group(9, 0.5))
    assert run("--config_path", str(tmp_path / "small.yaml"), "--second.updates", "9") == expected


@pytest.mark.parametrize("content", ["[1]", "steps: [", "stepz: 1", "first:", "# bad.yaml\nfirst: 3"])
def test_a_damaged_file_of_settings_is_one_line(run, tmp_path, capsys, content):
    (tmp_path / "bad.yaml").write_text(content)
    with pytest.raises(SystemExit) as end:
        run("--config_path", str(tmp_path / "bad.yaml"))
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1 and ("bad.yaml" in error or "stepz" in error)


@pytest.mark.parametrize(
    ("option", "advice"),
    [
        ("--step", "--steps?"),
        ("--dry-runs", "--dry_run?"),
        ("--updates", "--first.updates or --second.updates?"),
        ("--first_updates", "--first.updates?"),
        ("--bogus", "--help"),
    ],
)
def test_an_unknown_option_is_refused_with_a_suggestion(run, capsys, option, advice):
    with pytest.raises(SystemExit) as end:
        run(option, "1")
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1
    assert error.startswith("error: ") and advice in error


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (["--steps", "many"], "steps"),
        (["--first.updates", "many"], "first.updates"),
        (["--first.updates", "0"], "--first.updates or --second.updates must be at least 1, got 0"),
        (["--steps"], "--steps"),
        (["stray"], "stray"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_option(run, capsys, arguments, name):
    with pytest.raises(SystemExit) as end:
        run(*arguments)
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1 and name in error


def test_ctrl_c_says_how_to_go_on(run):
    def main(config):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit, match="stopped; the same command resumes"):
        run(main=main)
    with pytest.raises(SystemExit, match="stopped; again"):
        run_recipe(main, Settings, ["recipes/some.py"], stopped="again")


def allocate(config):
    torch.empty(10**15)


def hoard(config):
    raise MemoryError


@pytest.mark.parametrize("main", [allocate, hoard])
def test_too_little_memory_is_one_line(run, capsys, main):
    with pytest.raises(SystemExit) as end:
        run(main=main)
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: {MEMORY}\n"


def test_an_unexpected_error_has_its_traceback(run):
    def main(config):
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="mat1"):
        run(main=main)


def test_debug_shows_the_traceback_of_an_expected_error(run):
    def main(config):
        raise ValueError("expected")

    with pytest.raises(ValueError, match="expected"):
        run("--debug", main=main)
    with pytest.raises(SystemExit):
        run(main=main)


def test_an_error_of_the_user_s_code_is_named_by_its_place(run, capsys, tmp_path):
    (tmp_path / "my_code.py").write_text(
        "import numpy as np\n\ndef act():\n    return np.zeros(3) + np.zeros(2)\n"
    )
    space = {}
    exec(compile((tmp_path / "my_code.py").read_text(), tmp_path / "my_code.py", "exec"), space)
    with pytest.raises(SystemExit):
        run(main=lambda config: space["act"]())
    assert "raised in my_code.py, line 4 (act)" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run(main=lambda config: parse_seeds("x"))
    assert "raised in" not in capsys.readouterr().err


def test_the_command_does_not_depend_on_where_the_repository_lies():
    argv = ["/somewhere/recipes/paper/tables.py", "--only", "a b"]
    assert command_line(argv) == "python recipes/paper/tables.py --only 'a b'"


def test_options_without_effect_are_refused():
    refuse(Group(3), Group(), ["rate"], "--other")
    with pytest.raises(ValueError, match=r"--first\.updates .* --other"):
        refuse(Group(3), Group(), ["rate", "updates"], "--other", "first.")


def test_seeds():
    assert parse_seeds("0,12") == [0, 12]
    for text in ("a", "", "1,1", "0,-1"):
        with pytest.raises(ValueError, match="--seeds"):
            parse_seeds(text)


def test_the_library_does_not_read_the_command_line():
    """Only a process that runs a script sets its arguments."""
    found = {}
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Attribute) and node.attr == "argv":
                found.setdefault(str(path.relative_to(PACKAGE)), []).append(type(node.ctx))
            assert not (isinstance(node, ast.ImportFrom) and node.module == "sys")
    assert found == {"utils/processes.py": [ast.Store], "utils/ray_train.py": [ast.Store]}
