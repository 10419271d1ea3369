"""Recipes as commands: options, flags, and errors in one line."""

import sys
from dataclasses import dataclass

import pytest
import torch

from dynmap_rl import commands  # MODULE


@dataclass
class Settings:
    steps: int = 3
    rate: float = 0.1
    dry_run: bool = False


def run(monkeypatch, main, *arguments):
    monkeypatch.setattr("sys.argv", ["recipes/some.py", *arguments])
    monkeypatch.setattr("sys.path", [*sys.path])
    commands.run_recipe(main, Settings)


@pytest.mark.parametrize("arguments", [["--dry-run"], ["--dry_run", "True"], ["--dry-run=true"]])
def test_options_with_hyphens_and_bare_flags(monkeypatch, arguments):
    seen = []
    run(monkeypatch, seen.append, *arguments, "--steps=-4")
    assert seen == [Settings(steps=-4, dry_run=True)]


@pytest.mark.parametrize(
    ("option", "advice"),
    [("--step", "do you mean --steps?"), ("--bogus", "see --help"), ("--dry-runs", "--dry_run?")],
)
def test_an_option_that_there_is_not(monkeypatch, capsys, option, advice):
    with pytest.raises(SystemExit) as end:
        run(monkeypatch, print, option, "1")
    error = capsys.readouterr().err
    assert end.value.code == 2 and error.count("\n") == 1
    assert error.startswith("error: there is no option --") and advice in error


def allocate(config):
    torch.empty(10**15)


def hoard(config):
    raise MemoryError


@pytest.mark.parametrize("main", [allocate, hoard])
def test_too_little_memory_is_one_line(monkeypatch, capsys, main):
    with pytest.raises(SystemExit) as end:
        run(monkeypatch, main)
    assert end.value.code == 2
    assert capsys.readouterr().err == f"error: {commands.MEMORY}\n"


def test_a_mistake_of_ours_shows_where(monkeypatch):
    def main(config):
        raise RuntimeError("mat1 and mat2 shapes cannot be multiplied")

    with pytest.raises(RuntimeError, match="mat1"):
        run(monkeypatch, main)


def test_the_command_is_the_same_wherever_the_repository_lies(monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/recipes/expert.py", "--task", "bin_dropping"])
    assert commands.command_line() == "python recipes/expert.py --task bin_dropping"


def test_only_what_was_not_asked_for_is_replaced(monkeypatch):
    monkeypatch.setattr("sys.argv", ["recipes/some.py", "--dry-run", "false"])
    config = Settings(steps=7)
    commands.replace_defaults(config, {"steps": 1, "rate": 0.2, "dry_run": True})
    assert config == Settings(steps=7, rate=0.2, dry_run=False)
