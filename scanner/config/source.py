"""A YAML file as plain data that remembers where every key and value stands."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scanner.config.problems import ConfigError, FieldPath, Problem, dotted, show

_LARGEST_FILE = 1 << 20  # bytes; more is no configuration but a mistaken path

Place = tuple[int, int]
"""(line, column), counted from 1; (0, 0) stands for an override."""


@dataclass
class Source:
    """The data of a file, the places of its keys and values, and the mistakes of its YAML.

    Parameters
    ----------
    file
        The file as the operator named it.
    data
        Nested dicts, lists and scalars.
    keys, values
        Where the key and the value of each field stand.
    problems
        What YAML allows and a configuration does not.
    """

    file: str
    data: Any = None
    keys: dict[FieldPath, Place] = field(default_factory=dict)
    values: dict[FieldPath, Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def problem(
        self, path: FieldPath, what: str, remedy: str, *, at_key: bool = False, name: FieldPath | None = None
    ) -> Problem:
        """Make a problem of the field ``name`` (``path`` if None) that stands at ``path`` or its nearest section."""
        place = None if at_key else self.values.get(path)
        known = path
        while place is None and known:
            place = self.keys.get(known) or self.values.get(known)
            known = known[:-1]
        line, column = place or (1, 1)
        field_name = dotted(path if name is None else name)
        if line == 0:
            return Problem(f"{self.file} with an override", None, None, field_name, what, remedy)
        return Problem(self.file, line, column, field_name, what, remedy)

    def override(self, overrides: Mapping[str, Any]) -> None:
        """Put values in place of those of the file; keys are dotted, such as ``scan.method``."""
        for name, value in overrides.items():
            path = tuple(name.split("."))
            section = self.data
            for i, step in enumerate(path[:-1]):
                if section.get(step) is None:
                    section[step] = {}
                    self.keys[path[: i + 1]] = self.values[path[: i + 1]] = (0, 0)
                section = section[step]
                if not isinstance(section, dict):
                    what = f"found {show(section)}, expected a section: {name} is to be overridden"
                    remedy = "correct the override, or make this a section"
                    raise ConfigError.of([self.problem(path[: i + 1], what, remedy)])
            for places in (self.keys, self.values):
                for old in [known for known in places if known[: len(path)] == path]:
                    del places[old]
                places[path] = (0, 0)
            section[path[-1]] = value


def read_source(path: Path, start: str = "what the file is to say") -> Source:
    """Read a YAML file.

    Parameters
    ----------
    path
        The file.
    start
        What the operator is told to write into an empty file.

    Raises
    ------
    ConfigError
        The file cannot be read, is not YAML, or holds no sections.
    """
    text = _read(path)
    source = Source(str(path))
    _parse(text, source)
    if not source.problems and not isinstance(source.data, dict):
        found = "an empty file" if source.data is None else show(source.data)
        what = f"found {found}, expected lines such as `name: value`"
        source.problems.append(source.problem((), what, f"write {start}"))
    if source.problems:
        raise ConfigError.of(source.problems)
    return source


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(_LARGEST_FILE + 1)
        if len(raw) > _LARGEST_FILE:
            what, remedy = "found more than 1 MiB, expected a configuration of a few lines", "name a YAML file"
        else:
            return raw.decode("utf-8-sig")
    except FileNotFoundError:
        near = difflib.get_close_matches(path.name, _names_in(path.parent), n=1)
        what = "found no such file, expected a configuration"
        remedy = f"did you mean {path.with_name(near[0])}?" if near else "correct the path"
    except IsADirectoryError:
        inside = [name for name in _names_in(path) if name.endswith((".yaml", ".yml"))][:5]
        what = "found a folder, expected a YAML file"
        remedy = f"name a file in it: {', '.join(inside)}" if inside else "name a YAML file"
    except PermissionError:
        what = "found a file that you may not read, expected a readable one"
        remedy = "ask its owner for permission to read it"
    except UnicodeDecodeError as error:
        before = error.object[: error.start].decode("utf-8")
        what = f"found the byte 0x{raw[error.start]:02x}, which is not UTF-8, expected a text file"
        remedy = "name a YAML file, and save it with the encoding UTF-8"
        raise ConfigError.of([Problem(str(path), *_place(before), "", what, remedy)]) from None
    except (OSError, ValueError) as error:
        what = f"the file cannot be read: {getattr(error, 'strerror', None) or error}"
        remedy = "check the path and the disk"
    raise ConfigError.of([Problem(str(path), None, None, "", what, remedy)])


def _names_in(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in folder.iterdir())
    except OSError:
        return []


def _place(before: str) -> Place:
    """Line and column of what follows the text ``before``."""
    return before.count("\n") + 1, len(before) - before.rfind("\n")


def _parse(text: str, source: Source) -> None:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError
    from ruamel.yaml.reader import ReaderError

    yaml = YAML(typ="safe", pure=True)  # the C parser knows no columns
    try:
        root = yaml.compose(text)
        if root is not None:
            source.data = _plain(root, (), source, yaml.constructor, set())
    except MarkedYAMLError as error:
        raise ConfigError.of([_syntax_problem(error, text, source.file)]) from None
    except ReaderError as error:
        what = f"found the control character 0x{ord(text[error.position]):02x}, expected text"
        place = _place(text[: error.position])
        raise ConfigError.of([Problem(source.file, *place, "", what, "delete this character")]) from None
    except RecursionError:
        what = "found hundreds of levels, expected sections and a few levels below them"
        raise ConfigError.of([Problem(source.file, 1, 1, "", what, "name a scan configuration")]) from None


def _plain(node: Any, path: FieldPath, source: Source, constructor: Any, seen: set[int]) -> Any:
    """Turn a YAML node into plain data, noting places and mistakes in ``source``."""
    is_alias = id(node) in seen
    seen.add(id(node))
    is_left_out = node.id == "scalar" and not node.value and node.style is None
    if not (is_alias or is_left_out):  # else the key alone has a place worth telling
        source.values[path] = _start(node)
    what = remedy = ""
    value: Any = None
    if is_alias:
        # Copies of copies can grow without bound, and a value with two places has no line to point at.
        what, remedy = "found an alias (*name), expected a value", "write the value out"
    elif node.id == "mapping":
        value = _plain_mapping(node, path, source, constructor, seen)
    elif node.id == "sequence":
        value = [_plain(item, (*path, i), source, constructor, seen) for i, item in enumerate(node.value)]
    elif str(node.tag) == "tag:yaml.org,2002:timestamp":
        value = node.value  # no field is a date, but a serial number may look like one
    else:
        try:
            value = constructor.construct_object(node)
        except ValueError as error:
            what, remedy = f"found {show(node.value)}, which cannot be read: {error}", "put it in quotes"
        if isinstance(value, float) and not math.isfinite(value):
            what, remedy = f"found {node.value}, expected a finite number", "write a number"
    if what:
        source.problems.append(source.problem(path, what, remedy))
    return value


def _plain_mapping(node: Any, path: FieldPath, source: Source, constructor: Any, seen: set[int]) -> dict[str, Any]:
    mapping: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = constructor.construct_object(key_node) if key_node.id == "scalar" else None
        if not isinstance(key, str):
            found = show(key) if key_node.id == "scalar" else "a list or section"
            what = f"found {found} as a key, expected a name"
            problem = Problem(source.file, *_start(key_node), dotted(path), what, "write `name: value`")
            source.problems.append(problem)
        elif key in mapping:
            first = source.keys[*path, key][0]
            what = f"found this key a second time, expected it once; the first is on line {first}"
            name = dotted((*path, key))
            problem = Problem(source.file, *_start(key_node), name, what, "remove one of the two")
            source.problems.append(problem)
        else:
            source.keys[*path, key] = _start(key_node)
            mapping[key] = _plain(value_node, (*path, key), source, constructor, seen)
    return mapping


def _start(node: Any) -> Place:
    return node.start_mark.line + 1, node.start_mark.column + 1


def _syntax_problem(error: Any, text: str, file: str) -> Problem:
    mark = error.problem_mark or error.context_mark
    lines = text.splitlines()
    line = lines[mark.line] if mark.line < len(lines) else ""
    said = f"{error.problem}" + (f" {error.context}" if error.context else "")
    what = f"found {show(line.strip()) if line else 'the end of the file'}, expected valid YAML: {said}"
    if "\t" in line[: len(line) - len(line.lstrip())]:
        what = "found a tab before the first word, expected spaces: YAML is indented with spaces only"
        remedy = "replace the tab, for instance by two spaces for each level"
    elif "another document" in said:
        remedy = "remove the line `---` and what follows: one file is one configuration"
    elif "tag" in said:
        remedy = "remove the word that begins with `!`, and write `<<` keys out"
    elif "alias" in said:
        remedy = "put the text in quotes, or write the value out"
    else:
        remedy = (
            "write `name: value` with a blank after the colon, keep one indent within a section and close every "
            "bracket and quote; the slip may be on the line above"
        )
    return Problem(file, mark.line + 1, mark.column + 1, "", what, remedy)
