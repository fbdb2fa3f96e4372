"""From pydantic's errors to problems an operator can correct: where, what was expected, and the remedy."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from scanner.config.models import FRACTION
from scanner.config.problems import FieldPath, Problem, show
from scanner.config.source import Source

Node = Mapping[str, Any]
"""A part of a JSON schema."""


def explain(error: ValidationError, source: Source, json_schema: Node) -> list[Problem]:
    """Turn all that pydantic found in a file into problems, in the order of the file.

    Parameters
    ----------
    error
        From the validation of ``source.data``.
    source
        The file.
    json_schema
        Of the model that refused it.
    """
    schema = _Schema(json_schema)
    problems: dict[FieldPath, Problem] = {}
    renamed: set[FieldPath] = set()
    # Unknown keys first: where one stands for a missing field, that one is not missing too. Short lists last: pydantic
    # counts the sound items only.
    order = {"extra_forbidden": 0, "too_short": 2}
    for item in sorted(error.errors(include_url=False), key=lambda e: order.get(e["type"], 1)):
        kind, value = item["type"], item["input"]
        spot = schema.locate(item["loc"], source.data, ends_in_key=kind in ("extra_forbidden", "missing"))
        if kind == "too_short" and any(path[: len(spot.path)] == spot.path for path in problems):
            continue
        if kind == "extra_forbidden":
            remedy, meant = _right_name(spot, value, schema, source.data)
            renamed |= {(*spot.path[:-1], meant)} if meant else set()
            what = f"found an unknown key, expected one of: {', '.join(sorted(spot.siblings)) or 'none'}"
            problem = source.problem(spot.path, what, remedy, at_key=True)
        elif kind == "missing":
            if spot.path in renamed:
                continue
            section = f"below `{spot.path[-2]}:`" if len(spot.path) > 1 else "to the file"
            remedy = f"add `{spot.path[-1]}: …` {section}{_description(spot.node)}"
            what = f"found nothing, expected {schema.expectation(spot.node) or 'a value'}"
            problem = source.problem(spot.path[:-1], what, remedy, at_key=True, name=spot.path)
        elif kind == "refused":
            problem = source.problem(spot.path, item["ctx"]["what"], item["ctx"]["remedy"])
        elif kind in ("union_tag_invalid", "union_tag_not_found"):
            problem = _wrong_member(spot, item["ctx"], schema, source)
        elif item["msg"].startswith(_SAID_BY_SCHEMA) and (expected := schema.expectation(spot.node)):
            remedy = _right_value(spot, value, expected)
            problem = source.problem(spot.path, f"found {show(value)}, expected {expected}", remedy)
        else:
            said = item["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
            remedy = f"correct it{_description(spot.node)}"
            what = f"found {show(value)}: {said}".replace(": Input should be", ", expected")
            problem = source.problem(spot.path, what, remedy)
        # A plain union complains once for each member; the first complaint speaks for all.
        problems.setdefault(spot.path, problem)
    return sorted(problems.values(), key=lambda p: (p.line or 0, p.column or 0))


@dataclass(frozen=True)
class _Spot:
    """A field: its path in the file, its schema, and the schemas of the fields that can stand beside it."""

    path: FieldPath
    node: Node
    siblings: Mapping[str, Node]


@dataclass(frozen=True)
class _Schema:
    """The JSON schema of a configuration; it knows the fields of a bench whatever its model is made of."""

    root: Node

    def branches(self, node: Node, value: Any) -> list[Node]:
        """Follow references and unions to the plain schemas that ``value`` may be meant for."""
        if "$ref" in node:
            return self.branches(self.root["$defs"][node["$ref"].removeprefix("#/$defs/")], value)
        tag = self.tag(node, value)
        if tag is not None:
            return self.branches({"$ref": node["discriminator"]["mapping"][tag]}, value)
        members = node.get("oneOf") or node.get("anyOf") or node.get("allOf")
        return [b for member in members for b in self.branches(member, value)] if members else [node]

    def tag(self, node: Node, value: Any) -> str | None:
        """Find which member of a discriminated union ``value`` names."""
        union = node.get("discriminator", {})
        tag = value.get(union.get("propertyName")) if isinstance(value, dict) else None
        return tag if isinstance(tag, str) and tag in union.get("mapping", {}) else None

    def fields(self, node: Node, value: Any) -> dict[str, Node]:
        """Collect the schemas of the fields that ``value`` may have, by name."""
        return {k: v for b in self.branches(node, value) for k, v in b.get("properties", {}).items()}

    def locate(self, location: Sequence[str | int], data: Any, *, ends_in_key: bool) -> _Spot:
        """Find the field that pydantic means; its locations also hold names of union members, which are no keys."""
        path: list[str | int] = []
        node, value, siblings = self.root, data, self.fields(self.root, data)
        tag = None
        for i, step in enumerate(location):
            fields = self.fields(node, value)
            is_key = step in fields or (isinstance(value, dict) and step in value)
            is_last_key = ends_in_key and i + 1 == len(location)
            if step == tag and not is_last_key:
                tag = None
            elif isinstance(step, int) and isinstance(value, list):
                node = self._item(step, node, value)
                value = value[step] if step < len(value) else None
                path.append(step)
            elif is_key or is_last_key:
                siblings = fields
                free = (branch.get("additionalProperties") for branch in self.branches(node, value))
                node = fields.get(str(step)) or next((n for n in free if isinstance(n, dict)), {})
                value = value.get(step) if isinstance(value, dict) else None
                tag = self.tag(node, value)
                path.append(step)
        return _Spot(tuple(path), node, siblings)

    def _item(self, index: int, node: Node, value: Any) -> Node:
        for branch in self.branches(node, value):
            for item in (*branch.get("prefixItems", [])[index : index + 1], branch.get("items")):
                if isinstance(item, dict):
                    return item
        return {}

    def expectation(self, node: Node, *, within_list: bool = False) -> str:
        """Say in words what a field takes; empty where the schema does not tell."""
        words = []
        for branch in self.branches(node, None):
            kind = branch.get("type")
            if "const" in branch or "enum" in branch:
                words.append(" or ".join(show(c) for c in branch.get("enum", [branch.get("const")])))
            elif kind == "array":
                items = branch.get("items")
                # One level is enough, and a type may hold lists of itself.
                inner = ""
                if isinstance(items, dict) and not within_list:
                    inner = self.expectation(items, within_list=True)
                least = f" of at least {branch['minItems']}" if "minItems" in branch else ""
                words.append(f"a list{least}{f' (each {inner})' if inner else ''}")
            elif kind == "object":
                names = ", ".join(branch.get("properties", {}))
                words.append(f"a section with {names}" if names else "a section")
            elif branch.get("pattern") == FRACTION:
                words.append("a fraction such as 81/1280")
            elif kind in _TYPES:
                bounds = [f"{sign} {branch[bound]:g}" for bound, sign in _BOUNDS.items() if bound in branch]
                filled = ["that is not empty"] if branch.get("minLength") == 1 else []
                words.append(" ".join([_TYPES[kind], " and ".join(bounds + filled)]).strip())
        return " or ".join(dict.fromkeys(words))

    def sections_with(self, key: str, node: Node, data: Any, above: tuple[str, ...] = ()) -> Iterator[str]:
        """Dotted names of the sections that have a field ``key``."""
        fields = self.fields(node, data)
        if key in fields and above:
            yield ".".join(above)
        for name, sub in fields.items() if len(above) < 4 else ():
            below = data.get(name) if isinstance(data, dict) else None
            yield from self.sections_with(key, sub, below, (*above, name))


_SAID_BY_SCHEMA = ("Input should be", "Tuple should have", "List should have", "String should have")
"""Beginnings of pydantic's messages that say less, and in programmers' words, than the schema of the field."""

_TYPES = {"integer": "an integer", "number": "a number", "string": "a text", "boolean": "true or false", "null": "null"}
_BOUNDS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}

_UNITS = {
    "ns": ("time", 1e-9),
    "us": ("time", 1e-6),
    "ms": ("time", 1e-3),
    "s": ("time", 1.0),
    "um": ("length", 1e-6),
    "mm": ("length", 1e-3),
    "cm": ("length", 1e-2),
    "m": ("length", 1.0),
    "mrad": ("angle", 1e-3),
    "rad": ("angle", 1.0),
    "deg": ("angle", math.pi / 180),
    "hz": ("rate", 1.0),
    "khz": ("rate", 1e3),
}


def _stem_and_unit(name: str) -> tuple[str, str | None]:
    stem, _, last = name.rpartition("_")
    return (stem, last) if stem and last in _UNITS else (name, None)


def _units_like(unit: str) -> list[str]:
    return [other for other in _UNITS if _UNITS[other][0] == _UNITS[unit][0]]


def _written(unit: str) -> str:
    return {"us": "µs", "um": "µm", "deg": "°", "hz": "Hz", "khz": "kHz"}.get(unit, unit)


def _convert(value: float, unit: str, wanted: str) -> str:
    return show(value * _UNITS[unit][1] / _UNITS[wanted][1])


def _right_name(spot: _Spot, value: Any, schema: _Schema, data: Any) -> tuple[str, str | None]:
    """Remedy for an unknown key, and the field beside it that was probably meant."""
    key = re.sub(r"[\s-]+", "_", str(spot.path[-1]).strip().lower()).replace("µ", "u")
    stem, unit = _stem_and_unit(key)
    stems = {_stem_and_unit(name)[0]: name for name in spot.siblings}
    elsewhere = list(dict.fromkeys(schema.sections_with(str(spot.path[-1]), schema.root, data)))[:3]
    # Whole names before stems, so that exposure_time_ms still finds exposure_us.
    near = difflib.get_close_matches(key, spot.siblings, n=1)
    near = near or [stems[s] for s in difflib.get_close_matches(stem, stems, n=1)]
    if key in spot.siblings:
        meant = key
    elif stem in stems:
        meant = stems[stem]
    elif elsewhere:
        return f"move it below {' or '.join(f'`{section}:`' for section in elsewhere)}", None
    elif near:
        meant = near[0]
    else:
        return "remove it", None

    wanted = _stem_and_unit(meant)[1]
    if wanted is None or unit == wanted:
        return f"did you mean `{meant}: {show(value)}`?" if _is_short(value) else f"did you mean `{meant}`?", meant
    if not isinstance(value, int | float) or isinstance(value, bool) or (unit and unit not in _units_like(wanted)):
        return f"did you mean `{meant}`? Its unit is {_written(wanted)}", meant
    if unit is not None:
        number = _convert(value, unit, wanted)
        return f"did you mean `{meant}: {number}`? The unit is {_written(wanted)}, not {_written(unit)}", meant
    others = [f"{_convert(value, u, wanted)} if you mean {_written(u)}" for u in _units_like(wanted) if u != wanted]
    said = f"The unit is {_written(wanted)}; write {', '.join(others)}"
    return f"did you mean `{meant}: {show(value)}`? {said}", meant


def _right_value(spot: _Spot, value: Any, expected: str) -> str:
    """Remedy for a value of the wrong type, or out of range."""
    key = next((str(step) for step in reversed(spot.path) if isinstance(step, str)), "the file")
    if isinstance(value, str) and ("number" in expected or "integer" in expected):
        text, wanted = value.strip(), _stem_and_unit(key)[1]
        quantity = re.fullmatch(r"([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*([a-zA-Zµ]*)", text)
        unit = quantity[2].lower().replace("µ", "u") if quantity else ""
        if quantity and wanted and unit in _units_like(wanted):
            number = _convert(float(quantity[1]), unit, wanted)
            return f"write `{key}: {number}`: the unit, {_written(wanted)}, is part of the name"
        if quantity and not unit:
            return f"write {text} without quotes"
        if re.fullmatch(r"[-+]?\d+,\d+", text):
            return f"write {text.replace(',', '.')}, with a decimal point"
    if expected.startswith("a list") and not isinstance(value, dict | list) and value is not None:
        return f"write `{key}: [{show(value)}]`"
    choices = [str(choice) for choice in spot.node.get("enum", [])]
    if isinstance(value, str) and (near := difflib.get_close_matches(value.lower(), choices, n=1)):
        return f"did you mean `{near[0]}`?"
    default = spot.node.get("default")
    in_doubt = f", {show(default)} when in doubt" if _is_short(default) else ""
    return f"give {key} {expected}{in_doubt}{_description(spot.node)}"


def _wrong_member(spot: _Spot, context: Mapping[str, Any], schema: _Schema, source: Source) -> Problem:
    """Problem of a union, such as a scene, whose member does not exist or is not named."""
    key = str(context["discriminator"]).strip("'")
    members = [branch.get("properties", {}).get(key, {}) for branch in schema.branches(spot.node, None)]
    choices = [show(c) for member in members for c in member.get("enum", [member.get("const")]) if c is not None]
    path = (*spot.path, key)
    if "tag" not in context:
        what = f"found nothing, expected one of: {', '.join(choices)}"
        return source.problem(spot.path, what, f"add `{key}: {choices[0] if choices else '…'}`", at_key=True, name=path)
    near = difflib.get_close_matches(str(context["tag"]).lower(), choices, n=1)
    remedy = f"did you mean `{near[0]}`?" if near else f"give {key} one of these names"
    return source.problem(path, f"found {show(context['tag'])}, expected one of: {', '.join(choices)}", remedy)


def _description(node: Node) -> str:
    text = str(node.get("description", "")).strip().rstrip(".")
    return f" ({text})" if text else ""


def _is_short(value: Any) -> bool:
    return value is not None and not isinstance(value, dict) and len(show(value)) < 60
