"""YAML files read strictly: every key known, every number finite, and whatever is wrong told with its line."""

from __future__ import annotations

import math
import re
from difflib import get_close_matches
from pathlib import Path

import yaml

from torchcmax.rig.errors import Refused

NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float", "tag:yaml.org,2002:str")  # YAML 1.1 takes 1e3 for text
TEXT = ("tag:yaml.org,2002:str", "tag:yaml.org,2002:int")  # part numbers are written without quotation marks too
NULL = "tag:yaml.org,2002:null"
WORD = re.compile("[A-Za-z0-9_-]{1,32}")
LARGEST = 1e15  # of numbers; what is below 1e-15 is taken for 0


class Section:
    """A mapping of a file, all of whose keys are known; `required` and `optional` are words."""

    def __init__(self, file: Path, name: str, node: yaml.Node, required: str, optional: str = "") -> None:
        self.file, self.name, self.node = file, name, node
        self.entries: dict[str, yaml.Node] = {}
        wanted, known = required.split(), required.split() + optional.split()
        if not isinstance(node, yaml.MappingNode):
            raise self.refused(f"{name} is no mapping", f"write {name}: {{{', '.join(wanted or known)}}}")
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.value not in known:
                near = get_close_matches(_shown(key), known, 1)
                hint = f"did you mean {near[0]}?" if near else f"the keys of {name} are {', '.join(known) or 'none'}"
                raise self.refused(f"unknown key {_shown(key)} in {name}", hint, key)
            if key.value in self.entries:
                raise self.refused(f"{key.value} is there twice in {name}", "keep one of them", key)
            self.entries[key.value] = value
        for key in wanted:
            if key not in self.entries:
                raise self.refused(f"{key} is missing in {name}", f"the keys of {name} are {', '.join(known)}")

    def refused(self, problem: str, remedy: str, node: yaml.Node | None = None) -> Refused:
        """The error to raise, told at a node, else where the section begins."""
        line = (node or self.node).start_mark.line + 1
        return Refused(f"{self.file}, line {line}: {problem}\n  what to do: {remedy}")

    def wrong(self, key: str, problem: str, remedy: str) -> Refused:
        """The error to raise for a value."""
        return self.refused(f"{key} of {self.name} {problem}", remedy, self.entries.get(key))

    def __contains__(self, key: str) -> bool:
        return key in self.entries and self.entries[key].tag != NULL

    def section(self, key: str, required: str, optional: str = "") -> Section:
        return Section(self.file, key, self.entries[key], required, optional)

    def items(self, key: str) -> list[yaml.Node]:
        """The nodes of a list, at least one."""
        node = self.entries[key]
        if not isinstance(node, yaml.SequenceNode) or not node.value:
            raise self.wrong(key, "is no list of anything", f"write {key}: [ ... ]")
        return list(node.value)

    def number(self, key: str, *, above: float = -LARGEST, least: float = -LARGEST, most: float = LARGEST) -> float:
        """A finite number > above, >= least and <= most."""
        value = self._number(key, self.entries[key])
        if not (value > above and least <= value <= most):
            ends = [
                f"above {above:g}" * (above > -LARGEST),
                f"at least {least:g}" * (least > -LARGEST),
                f"at most {most:g}" * (most < LARGEST),
            ]
            raise self.wrong(key, f"is {value:g}", f"it wants a number {' and '.join(filter(None, ends)) or 'below 1e15'}")
        return value

    def whole(self, key: str, least: int, most: int) -> int:
        """A whole number from least to most."""
        value = self.number(key, least=least, most=most)
        if value != round(value):
            raise self.wrong(key, f"is {value:g}", "it wants a whole number")
        return round(value)

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """A list of so many finite numbers."""
        nodes = self.items(key)
        if len(nodes) != count:
            raise self.wrong(key, f"holds {len(nodes)} numbers", f"it wants {count}")
        return tuple(self._number(key, node) for node in nodes)

    def text(self, key: str) -> str:
        """A line of text."""
        node = self.entries[key]
        if not isinstance(node, yaml.ScalarNode) or node.tag not in TEXT or not node.value or not node.value.isprintable():
            raise self.wrong(key, "is no text of one line", f'write {key}: "..."')
        return str(node.value)

    def word(self, key: str) -> str:
        """What can stand in names of files and columns of tables."""
        value = self.text(key)
        if not WORD.fullmatch(value):
            raise self.wrong(key, f"is {value}", "it wants letters of the alphabet, digits, _ and -, at most 32 of them")
        return value

    def choice(self, key: str, *known: str) -> str:
        value = self.text(key)
        if value not in known:
            raise self.wrong(key, f"is {value}", f"it is one of {', '.join(known)}")
        return value

    def flag(self, key: str) -> bool:
        node, known = self.entries[key], yaml.SafeLoader.bool_values
        if node.tag != "tag:yaml.org,2002:bool" or _shown(node).lower() not in known:
            raise self.wrong(key, f"is {_shown(node)}", "it wants true or false")
        return bool(known[_shown(node).lower()])

    def _number(self, key: str, node: yaml.Node) -> float:
        try:
            value = float(node.value) if isinstance(node, yaml.ScalarNode) and node.tag in NUMBERS else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) < LARGEST:
            raise self.wrong(key, f"is {_shown(node)}, no finite number", "it wants a decimal number in the unit that the key names")
        return value if abs(value) > 1 / LARGEST else 0.0


def _shown(node: yaml.Node) -> str:
    """For messages."""
    return str(node.value) if isinstance(node, yaml.ScalarNode) else "a mapping or a list"


def read(path: Path, required: str, optional: str = "") -> tuple[Section, bytes]:
    """A file's whole mapping, and its bytes."""
    try:
        content = path.read_bytes()
        node = yaml.compose(content.decode(), yaml.SafeLoader)
    except OSError as error:
        raise Refused(f"{path}: cannot be read: {error.strerror}\n  what to do: name a YAML file, see configs/rig") from error
    except UnicodeDecodeError as error:
        raise Refused(f"{path}: is no text in UTF-8\n  what to do: name a YAML file, see configs/rig") from error
    except RecursionError as error:
        raise Refused(f"{path}: is nested too deeply\n  what to do: begin from a file of configs/rig") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"{path}, line {mark.line + 1}" if mark else f"{path}"
        problem = getattr(error, "problem", None) or str(error)
        raise Refused(f"{place}: is no YAML: {problem}\n  what to do: mend it, see configs/rig") from error
    if node is None:
        raise Refused(f"{path}: is empty\n  what to do: begin from a file of configs/rig")
    return Section(path, path.name, node, required, optional), content
