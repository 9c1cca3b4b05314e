"""The command line's parser: options from dataclasses and YAML files, and errors that name the nearest word."""

from __future__ import annotations

import difflib
import re
import sys
from typing import Any, NoReturn

from jsonargparse import ActionConfigFile, ArgumentParser, set_parsing_settings

USAGE_ERROR = 2
CONFIG_HELP = "YAML file with any of the options below, as --print_config prints them; options behind it override it"


class Parser(ArgumentParser):
    """Exits with 2 and one clear message; an unknown option, key or command is answered with the nearest known one."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        name = self.prog.replace(" [options]", "")
        sys.stderr.write(f"{name}: {' '.join(message.split())}\n")
        for hint in self._hints(message):
            sys.stderr.write(f"  {hint}\n")
        sys.stderr.write(f"  {name} --help shows all\n")
        raise SystemExit(USAGE_ERROR)

    def _hints(self, message: str) -> list[str]:
        known = sorted(self.options())
        if match := re.search(r"nrecognized arguments: (.*)", message):
            typed = [word.split("=")[0] for word in match[1].split() if word.startswith("-")]
            return [_nearest(word, known) for word in typed]
        if match := re.search(r"does not accept option '([^']+)'|[Kk]ey ['\"]([^'\"]+)['\"] is not expected", message):
            return [_nearest(match[1] or match[2], [name.removeprefix("--") for name in known])]
        if match := re.search(r"invalid choice: '([^']+)' \(choose from (.*)\)", message):
            return [_nearest(match[1], re.findall(r"[\w-]+", match[2]))]
        if match := re.search(r"Literal\[(.*)\]. Got value: (\S+)", message):
            return [_nearest(match[2], re.findall(r"[\w-]+", match[1]))]
        return []

    def options(self) -> set[str]:
        """Every option string of this parser and of its subcommands."""
        names = {name for action in self._actions for name in action.option_strings if name.startswith("--")}
        for action in self._actions:
            for parser in (getattr(action, "_name_parser_map", None) or {}).values():
                names |= parser.options() if isinstance(parser, Parser) else set()
        return names


def _nearest(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.4)
    return f"{word} is not known; did you mean {near[0]}?" if near else f"{word} is not known"


def parser(prog: str, description: str) -> Parser:
    """A parser that reads the help of every option from the docstrings behind the dataclasses' fields."""
    set_parsing_settings(docstring_parse_attribute_docstrings=True)
    return Parser(prog=prog, description=description)


def command(description: str) -> Parser:
    """The parser of one subcommand, with --config."""
    sub = Parser(description=description)
    sub.add_argument("--config", action=ActionConfigFile, help=CONFIG_HELP)
    return sub
