"""The JSON schema of a configuration, with the settings of the installed benches."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel
from pydantic.errors import PydanticInvalidForJsonSchema
from pydantic.json_schema import models_json_schema

from scanner.config.benches import bench_kinds, load_bench_kind
from scanner.config.models import Config
from scanner.config.problems import ConfigError
from scanner.config.sections import load_section

if TYPE_CHECKING:
    from drivers.bench import BenchKind

_DEFINITIONS = "#/$defs/"


def json_schema() -> dict[str, Any]:
    """Describe a configuration with any installed bench as JSON schema (draft 2020-12), for editors.

    Benches that cannot be loaded are left out and named in ``$comment``.

    Raises
    ------
    ConfigError
        Two installed packages register the same bench kind.
    """
    kinds, broken = {}, []
    for name in sorted(bench_kinds()):
        try:
            kinds[name] = load_bench_kind(name)
        except ConfigError as error:
            broken.append(error.message)
    comment = {"$comment": f"left out: {'; '.join(broken)}"} if broken else {}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **comment, **schema_with(kinds)}


def schema_for(data: Mapping[str, Any]) -> dict[str, Any]:
    """Describe a configuration with the one bench that ``data`` names, if that can be loaded."""
    bench = data.get("bench")
    name = bench.get("kind") if isinstance(bench, dict) else None
    try:
        return schema_with({name: load_bench_kind(name)} if isinstance(name, str) else {})
    except ConfigError:
        return schema_with({})


def schema_with(kinds: Mapping[str, BenchKind]) -> dict[str, Any]:
    """Describe a configuration whose ``bench`` is one of ``kinds``, told apart by its field ``kind``."""
    models: list[tuple[type[BaseModel], Literal["validation"]]] = [(Config, "validation")]
    for kind in kinds.values():
        if _has_schema(kind.settings):
            models.append((kind.settings, "validation"))
    calibration: type[BaseModel] | None = None
    with suppress(ConfigError):
        calibration = load_section("calibration")
        models.append((calibration, "validation"))
    # Made together, models of different packages that share a name keep apart.
    refs, schema = models_json_schema(models)
    definitions = schema["$defs"]
    bench = definitions["BenchSection"]
    mapping = {}
    for name, kind in kinds.items():
        ref = refs.get((kind.settings, "validation"))
        settings: dict[str, Any] = definitions[ref["$ref"].removeprefix(_DEFINITIONS)] if ref else {}
        kind_field = {**bench["properties"]["kind"], "const": name}
        definitions[f"bench_{name}"] = {
            "title": f"{name} bench",
            **settings,
            "type": "object",
            "properties": {"kind": kind_field, **settings.get("properties", {})},
            "required": ["kind", *settings.get("required", [])],
        }
        mapping[name] = f"{_DEFINITIONS}bench_{name}"
    if mapping:
        definitions["BenchSection"] = {
            "title": bench["title"],
            "description": bench["description"],
            "oneOf": [{"$ref": ref} for ref in mapping.values()],
            "discriminator": {"propertyName": "kind", "mapping": mapping},
        }
    root: dict[str, Any] = definitions.pop(refs[Config, "validation"]["$ref"].removeprefix(_DEFINITIONS))
    if calibration is not None:
        field = root["properties"]["calibration"]
        field["anyOf"] = [refs[calibration, "validation"], {"type": "null"}]
    return {**root, "$defs": definitions}


def _has_schema(model: type[BaseModel]) -> bool:
    try:
        model.model_json_schema()
    except PydanticInvalidForJsonSchema:
        return False
    return True
