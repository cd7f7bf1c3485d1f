# SPDX-License-Identifier: GPL-3.0-or-later
"""The parser of ``physgen``: commands in groups, one short usage line, errors without the list of flags."""

from __future__ import annotations

import argparse
import textwrap
from typing import Any, NoReturn

HELP_WIDTH = 100
"""Widest line of a help text, in characters."""
MOST_USAGE_FLAGS = 6
"""A command with more optional flags shows ``[options]`` in their place."""
COMMAND_COLUMN = 16
"""Column at which the commands' texts begin."""


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Argparse's own, no wider than ``HELP_WIDTH``; descriptions keep their lines."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28)
        self._width = min(self._width, HELP_WIDTH)


class CommandParser(argparse.ArgumentParser):
    """A parser whose usage is one line, and whose errors leave the list of all flags to ``--help``."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=HelpFormatter, allow_abbrev=False, **settings)

    def format_usage(self) -> str:
        """Return the usage; with many flags only what has to be given, and ``[options]``."""
        actions = self._actions
        if self.usage is not None:
            return super().format_usage()
        optional = [item for item in actions if item.option_strings and not item.required]
        if len(optional) <= MOST_USAGE_FLAGS:
            return super().format_usage()
        formatter = self._get_formatter()
        formatter.add_usage(None, [item for item in actions if item not in optional], [], prefix="")
        needed = formatter.format_help().strip().removeprefix(self.prog).strip()
        return f"usage: {self.prog} {needed} [options]\n"

    def format_help(self) -> str:
        """Return the help with the usage of ``format_usage``."""
        given = self.usage
        self.usage = self.format_usage().removeprefix("usage: ").strip().replace("%", "%%")
        try:
            return super().format_help()
        finally:
            self.usage = given

    def error(self, message: str) -> NoReturn:
        """Exit with code 2: the usage, where flags are listed, and last what is wrong: farms record the last line."""
        text = f"{self.format_usage()}all options: {self.prog} --help\n{self.prog}: error: {message}\n"
        self.exit(2, text)


def command_list(groups: dict[str, list[tuple[str, str]]]) -> str:
    """Return the commands with their texts, a heading a group, no line wider than ``HELP_WIDTH`` characters."""
    lines = []
    for title, commands in groups.items():
        lines += ["", f"{title}:"]
        for name, text in commands:
            lines += textwrap.wrap(
                text,
                width=HELP_WIDTH,
                initial_indent=f"  {name:<{COMMAND_COLUMN - 2}}",
                subsequent_indent=" " * COMMAND_COLUMN,
            )
    return "\n".join(lines)
