"""The command line's parser: options from dataclasses and YAML files, and errors that name the nearest word."""

from __future__ import annotations

import difflib
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import yaml
from jsonargparse import ActionConfigFile, ArgumentParser, Namespace, set_parsing_settings

USAGE_ERROR = 2
NAMED = ("recording", "out")  # what is worked on is named on the command line
CONFIG_HELP = "YAML file with any of the options below, as --print_config prints them; options behind it override it"


class UsageError(ValueError):
    """An option that cannot be used as it is given.  The CLI exits with 2."""


@contextmanager
def usage() -> Iterator[None]:
    """A ValueError in here is about an option."""
    try:
        yield
    except ValueError as error:
        raise UsageError(str(error)) from error


class Parser(ArgumentParser):
    """Exits with 2 and one clear message; an unknown option, key or command is answered with the nearest known one."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)

    def parsed(self, arguments: list[str] | None) -> Namespace:
        """The options with their dataclasses made; whatever is wrong with them ends in `error`."""
        try:
            config = self.parse_args(arguments)
            for file in config[config.command].get("config") or []:
                self._check_keys(str(file))
            made: Namespace = self.instantiate(config)
        except (ValueError, TypeError, UnicodeDecodeError) as error:
            self.error(str(error))
        return made

    def _check_keys(self, file: str) -> None:
        """A configuration must not silently take the place of what is named on the command line."""
        keys = yaml.safe_load(Path(file).read_text(encoding="utf-8"))
        named = [key for key in NAMED if isinstance(keys, dict) and key in keys]
        if named:
            self.error(f"{file}: {' and '.join(named)} belong on the command line, not into a configuration")

    def dump(self, cfg: Namespace, *arguments: Any, **options: Any) -> str:
        """What --print_config prints: a file for --config."""
        kept = cfg.clone()
        for name in NAMED:
            kept.pop(name, None)
        text: str = super().dump(kept, *arguments, **options)
        return text

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
