"""Recipes as commands: typed settings from the command line, and one line for an expected error.

Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import errno
import json
import os
import re
import shlex
import sys
import sysconfig
import tempfile
import traceback
import typing
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from .graphics import check_mujoco_gl
from .settings import flatten, parse_numbers
from .version import find_commit

HINTS = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "free some space and repeat the command, which resumes"
    ),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "choose a folder that can be written to"),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR, errno.EISDIR), "choose another path"),
}
OUT_OF_MEMORY = re.compile("out of memory|can('t|not) allocate memory", re.IGNORECASE)
MEMORY = "not enough memory; reduce the batch (windows, batch, num_envs) or the number of episodes"


def run_recipe(
    main: Callable, config_class: type, argv: Sequence[str], stopped: str = "the same command resumes"
) -> None:
    """Parse the settings and call ``main(config)``.

    An expected error is printed as one line, and the process exits with code 2. ``--debug``, anywhere among the
    arguments, shows the traceback instead.

    Args:
        main: the recipe.
        config_class: dataclass of its settings; nested dataclasses become options such as ``--eval.split``.
        argv: ``sys.argv``.
        stopped: what to do after Ctrl-C.
    """
    # Large pages for torch's memory: small ones cost a fifth of a world model's training.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    os.environ.setdefault("MPLBACKEND", "Agg")  # figures are written, never shown
    sys.path.append(os.getcwd())  # a task named module:Class may lie here
    given = ["--help" if argument == "-h" else argument for argument in argv[1:] if argument != "--debug"]
    debug = len(given) < len(argv) - 1
    try:
        settings = parse_settings(config_class, read_arguments(given, config_class))
        check_mujoco_gl()  # before TorchRL is imported
        find_commit()  # results name the commit of the start
        main(settings)
    except KeyboardInterrupt:
        sys.exit(f"stopped; {stopped}")
    except Exception as error:
        message = describe_error(error, Path(argv[0]).resolve().parent)
        if debug or message is None:
            raise
        print(f"error: {_name_options(message, config_class)}", file=sys.stderr)
        sys.exit(2)


def parse_settings(config_class: type, arguments: Sequence[str]):
    """Return the dataclass of settings that options, then a file given by ``--config_path``, then defaults set.

    Draccus alone would replace a nested default such as ``PPOTraining(iterations=90)`` by ``PPOTraining()`` as soon as
    another option of the group is given, and in its help. ``--help`` begins with the docstring of the class's module.

    Raises:
        ValueError: the file is not a YAML file of settings.
    """
    import draccus
    import mergedeep
    import yaml

    read = draccus.parsers.decoding.decode_from_init
    # Shells leave --output=~/x as it is.
    draccus.decode.register(Path, lambda value, path: read(Path, value, path).expanduser())
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--config_path", type=lambda text: Path(text).expanduser())
    file, arguments = parser.parse_known_args(arguments)
    settings = draccus.encode(config_class())
    if file.config_path:
        given = read_settings(file.config_path)
        for name, group in given.items():
            if isinstance(settings.get(name), dict) and not isinstance(group, dict):
                raise ValueError(
                    f"{file.config_path} must have options under {name}, got {group!r}; correct it"
                )
        mergedeep.merge(settings, given)
    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as merged:
        yaml.safe_dump(settings, merged)
        merged.flush()
        options = draccus.argparsing.ArgumentParser(config_class, merged.name, exit_on_error=False)
        if "--help" in arguments:
            _complete_help(options.parser, config_class)
            options.parser.set_defaults(**flatten(settings))  # draccus would show those of the nested classes
            arguments = ["--help"]  # not the options before it, which draccus would refuse now
        return options.parse_args(arguments)


def _complete_help(parser: argparse.ArgumentParser, config_class: type) -> None:
    """Describe the recipe and ``--debug``, and hide draccus's options for a file of one group, which are refused."""
    parser.description = sys.modules[config_class.__module__].__doc__
    parser.add_argument("--debug", action="store_true", help="Show the traceback of an error.")
    known = {*list_options(config_class), "--help", "--config_path", "--debug"}
    for action in (action for group in parser._action_groups for action in group._group_actions):
        if known.isdisjoint(action.option_strings):
            action.help = argparse.SUPPRESS


def read_settings(path: Path) -> dict:
    """Read a YAML file of settings.

    Raises:
        ValueError: the file holds no mapping of names to values.
    """
    import yaml

    try:
        settings = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not valid YAML ({' '.join(str(error).split())}); correct it") from error
    if not isinstance(settings, dict):
        raise ValueError(f"{path} must map names of options to values, got {settings!r}; correct it")
    return settings


def list_options(config_class: type) -> dict[str, type]:
    """Return the type of every option of a dataclass of settings, nested ones by their dotted names."""
    return {
        f"{prefix}{name}": kind
        for group, prefix in _list_groups(config_class)
        for name, kind in typing.get_type_hints(group).items()
        if not dataclasses.is_dataclass(kind)
    }


def _list_groups(config_class: type, prefix: str = "--") -> list[tuple[type, str]]:
    """Return the dataclass itself and those nested in it, with the prefixes of their options."""
    groups = [(config_class, prefix)]
    for name, kind in typing.get_type_hints(config_class).items():
        if dataclasses.is_dataclass(kind):
            groups += _list_groups(kind, f"{prefix}{name}.")
    return groups


def _name_options(message: str, config_class: type) -> str:
    """Replace fields of settings in a message, such as ``Evaluation.episodes``, by their options."""
    groups = _list_groups(config_class)

    def options(field: re.Match) -> str:
        names = [prefix + field[2] for group, prefix in groups if group.__name__ == field[1]]
        return " or ".join(names) or field[0]

    return re.sub(r"\b([A-Z]\w*)\.(\w+)", options, message)


def read_arguments(given: Sequence[str], config_class: type) -> list[str]:
    """Normalise arguments: ``--dry-run`` becomes ``--dry_run``, and a bare flag is followed by ``true``.

    Values are YAML. Those of texts and paths are quoted, as YAML would read ``#1c1c1c`` as a comment, ``yes`` as true and
    ``2026-01-01`` as a date; ``null`` stays None where an option may be None.

    Raises:
        ValueError: an option is unknown, or a text begins with ``include``, a word of draccus.
    """
    options, arguments, quote = list_options(config_class), [], None
    for i, argument in enumerate(given):
        name, equals, value = argument.partition("=")
        if not name.startswith("--"):
            arguments.append(quote(argument) if quote else argument)
            quote = None
            continue
        name = f"--{name[2:].replace('-', '_')}"
        if name not in {*options, "--help", "--config_path"}:
            raise ValueError(f"unknown option {name}; {_suggest(name, options)}")
        kind = options.get(name)
        kinds = {*typing.get_args(kind), kind}
        quote = partial(_quote, optional=type(None) in kinds) if kinds & {str, Path} else None
        arguments.append(f"{name}={quote(value) if quote else value}" if equals else name)
        quote = None if equals else quote
        if kind is bool and not equals and "".join(given[i + 1 : i + 2]).lower() not in ("true", "false"):
            arguments.append("true")
    return arguments


def _quote(value: str, optional: bool) -> str:
    if value.startswith("include"):
        raise ValueError(
            f"a value must not begin with include, which draccus reads as a file to include, got {value}; write a path as "
            f"./{value}"
        )
    return value if value == "null" and optional else json.dumps(value, ensure_ascii=False)


def _suggest(name: str, options: dict[str, type]) -> str:
    nested = [option for option in options if option.replace(".", "_").endswith(name[2:].replace(".", "_"))]
    close = nested or difflib.get_close_matches(name, options, 1)
    return f"do you mean {' or '.join(close)}?" if close else "see --help"


def describe_error(error: BaseException, recipes: Path) -> str | None:
    """Return what went wrong and what to do, or None for an error that no user has caused.

    Args:
        error: the error.
        recipes: folder of the code that is not the user's own, besides the package.
    """
    from draccus.utils import DecodingError, DraccusException

    while isinstance(error, DraccusException) and not isinstance(error, DecodingError) and error.__cause__:
        error = error.__cause__  # raised by the settings themselves; a DecodingError names the option
    # Torch raises a RuntimeError where it finds no memory.
    out_of_memory = isinstance(error, RuntimeError) and OUT_OF_MEMORY.search(str(error))
    if isinstance(error, MemoryError) or out_of_memory:
        return MEMORY
    if not isinstance(error, ValueError | OSError | argparse.ArgumentError | DraccusException):
        return None
    hint = HINTS.get(getattr(error, "errno", None)) or _name_place(error, recipes)
    return f"{error}; {hint}" if hint else str(error)


def _name_place(error: BaseException, recipes: Path) -> str | None:
    """Return where code of the user's, such as a task, has raised an error or called a library that has."""
    libraries = [sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")]
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if any(map(path.is_relative_to, (Path(__file__).parents[1], recipes))):
            return None
        if path.exists() and not any(map(path.is_relative_to, libraries)):
            return f"raised in {path.name}, line {frame.lineno} ({frame.name}); --debug shows the traceback"
    return None


def refuse(settings, default, names: Sequence[str], other: str, prefix: str = "") -> None:
    """Refuse options that have no effect.

    Args:
        settings: dataclass of settings.
        default: the same dataclass with its defaults.
        names: fields that must have their default.
        other: option because of which they have no effect.
        prefix: of the options' names, such as ``world_model.``.

    Raises:
        ValueError: one of the fields differs from its default.
    """
    for name in names:
        if getattr(settings, name) != getattr(default, name):
            raise ValueError(f"--{prefix}{name} has no effect with {other}; leave it out")


def parse_seeds(text: str) -> list[int]:
    """Parse seeds such as ``0,1,2``.

    Raises:
        ValueError: an entry is no whole number of at least 0, or occurs twice.
    """
    seeds = parse_numbers(text, "--seeds")
    if len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ValueError(f"--seeds must be different numbers of at least 0, got {text}")
    return seeds


def command_line(argv: Sequence[str]) -> str:
    """Return the command of a recipe or a benchmark as it is given in the root of the repository."""
    parts = Path(argv[0]).resolve().parts
    start = max((i for i, part in enumerate(parts) if part in ("recipes", "tests")), default=-1)
    return shlex.join(["python", "/".join(parts[start:]), *argv[1:]])
