#!/usr/bin/env python3
"""Writes docs/examples/track_line.d.ts, the TypeScript types of docs/track_line.schema.json.

python docs/make_types.py
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SCHEMA = HERE / "track_line.schema.json"
TYPES = HERE / "examples" / "track_line.d.ts"
_NAMES = {"integer": "number", "number": "number", "string": "string", "boolean": "boolean"}
_TUPLE = 4
"""Arrays of so many items at most are tuples."""


def type_name(definition: str) -> str:
    """`hand_in_slot` as TypeScript writes it: `HandInSlot`."""
    return definition.title().replace("_", "")


def type_of(schema: dict[str, Any]) -> str:
    """The type of a part of the schema."""
    if "$ref" in schema:
        return type_name(schema["$ref"].rpartition("/")[2])
    if "enum" in schema:
        return " | ".join(json.dumps(value) for value in schema["enum"])
    for key, sign in (("oneOf", " | "), ("allOf", " & ")):
        if key in schema:
            return sign.join(map(type_of, schema[key]))
    kinds = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    return " | ".join("null" if kind == "null" else _kind(kind, schema) for kind in kinds)


def _kind(kind: str, schema: dict[str, Any]) -> str:
    if kind != "array":
        return _NAMES[kind]
    item, count = type_of(schema["items"]), schema.get("minItems")
    if count is not None and count == schema.get("maxItems") and count <= _TUPLE:
        return f"[{', '.join([item] * count)}]"
    return f"({item})[]" if "|" in item else f"{item}[]"


def declaration(name: str, schema: dict[str, Any]) -> str:
    """An interface of an object, else a type."""
    about = f"/** {schema['description']} */\n"
    if "properties" not in schema:
        return f"{about}export type {name} = {type_of(schema)};\n"
    lines = []
    for key, value in schema["properties"].items():
        optional = "" if key in schema["required"] else "?"
        lines += [f"  /** {value['description']} */", f"  {key}{optional}: {type_of(value)};"]
    return f"{about}export interface {name} {{\n" + "\n".join(lines) + "\n}\n"


def types(schema: dict[str, Any]) -> str:
    """All declarations."""
    named = {type_name(key): value for key, value in schema["$defs"].items()}
    named[schema["title"]] = schema
    head = "// Made of docs/track_line.schema.json by docs/make_types.py.\n"
    return "\n".join((head, *(declaration(name, value) for name, value in named.items())))


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    TYPES.write_text(types(json.loads(SCHEMA.read_text(encoding="utf-8"))), encoding="utf-8")
