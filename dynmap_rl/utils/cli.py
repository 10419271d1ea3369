"""Recipes as commands: settings from the command line, and one line for what goes wrong.

Torch is imported where it is used, so that ``--help`` is quick.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import errno
import os
import re
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path

HINTS = {
    **dict.fromkeys(
        (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "make room; the same command goes on where it was"
    ),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "choose a folder that can be written to"),
    **dict.fromkeys((errno.EEXIST, errno.ENOTDIR, errno.EISDIR), "choose another path"),
}
OUT_OF_MEMORY = re.compile("out of memory|can't allocate memory")
MEMORY = (
    "there is not enough memory for this; make --windows, --policy_batch, --num_envs or --episodes smaller"
)


def run_recipe(main, config_class) -> None:
    """Parse the settings, run ``main(config)``, and turn an expected error into one line and exit code 2.

    ``--debug`` (anywhere on the command line) shows the traceback instead.
    """
    import draccus

    # Large pages for torch's memory, whose small ones cost a fifth of a world model's training.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    sys.path.append(os.getcwd())  # where the module of a task named module:Class may lie; it shadows nothing
    given = [a for a in sys.argv[1:] if a != "--debug"]
    debug = len(given) < len(sys.argv) - 1
    try:
        main(draccus.parse(config_class, args=read_arguments(given, config_class), exit_on_error=False))
    except KeyboardInterrupt:
        sys.exit("stopped; the same command goes on where it was")
    except Exception as error:
        message = describe_error(error)
        if debug or message is None:
            raise
        print(f"error: {message}", file=sys.stderr)
        sys.exit(2)


def read_arguments(given: list[str], config_class) -> list[str]:
    """The arguments with underscores in the names of options (``--dry-run`` is ``--dry_run``), and ``true`` behind bare
    flags.

    Raises:
        ValueError: the settings have no such option.
    """
    fields = {f"--{field.name}": field for field in dataclasses.fields(config_class)}
    arguments = []
    for i, argument in enumerate(given):
        name, equals, value = argument.partition("=")
        if name.startswith("--"):
            name = f"--{name[2:].replace('-', '_')}"
            if name not in {*fields, "--help", "--config_path"}:
                close = difflib.get_close_matches(name, fields, 1)
                raise ValueError(
                    f"there is no option {name}; {f'do you mean {close[0]}?' if close else 'see --help'}"
                )
            argument = name + equals + value
        arguments.append(argument)
        flag = argument in fields and fields[argument].type in (bool, "bool")
        if flag and "".join(given[i + 1 : i + 2]).lower() not in ("true", "false"):
            arguments.append("true")
    return arguments


def describe_error(error: Exception) -> str | None:
    """What went wrong and what to do; None where it is a mistake of ours."""
    from draccus.utils import DraccusException

    if isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and OUT_OF_MEMORY.search(str(error))
    ):
        return MEMORY  # torch says it by a RuntimeError
    if not isinstance(error, ValueError | OSError | argparse.ArgumentError | DraccusException):
        return None
    hint = HINTS.get(getattr(error, "errno", None))
    return f"{error}; {hint}" if hint else str(error)


def replace_defaults(config, values: dict) -> None:
    """Set those fields of a dataclass that still have their default and are not on the command line: what was asked
    for stays."""
    given = {a.partition("=")[0][2:].replace("-", "_") for a in sys.argv[1:] if a.startswith("--")}
    for name, value in values.items():
        if name not in given and getattr(config, name) == getattr(type(config), name):
            setattr(config, name, value)


def check_at_least_one(config, *names: str) -> None:
    """Raises ``ValueError`` for one of these settings that is below 1; those that there are not do not matter."""
    for name in names:
        if (value := getattr(config, name, 1)) < 1:
            raise ValueError(f"--{name} must be at least 1, not {value}")


def refuse(config, names: Iterable[str], why: str) -> None:
    """Raises ``ValueError`` for one of these settings that is not its default, and would say nothing here."""
    for name in names:
        if getattr(config, name) != getattr(type(config), name):
            raise ValueError(f"--{name} {why}; leave it out")


def command_line() -> str:
    """The command that started this process, as it would be given in the root of the repository."""
    return shlex.join(["python", f"recipes/{Path(sys.argv[0]).name}", *sys.argv[1:]])
