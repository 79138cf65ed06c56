"""The schemas of what `--json` prints, as the documentation has them."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

_PAGE = Path(__file__).parents[1] / "docs/cli.md"
_TYPES: dict[str, Any] = {"str": str, "int": int, "num": (int, float), "bool": bool}
_NO_NUMBERS = {"NaN", "Infinity", "-Infinity"}
_ALIKE = {"index add": "index list", "index remove": "index list"}


@cache
def schemas() -> dict[str, Any]:
    """By command and, where they change what is printed, option."""
    text = _PAGE.read_text("utf-8")
    found = re.findall(r"^```json ([^\n]+)\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return {name: json.loads(schema) for name, schema in found}


def schema_of(words: Sequence[str]) -> Any:
    """The schema of a command as typed: that with the most of its words."""
    spelled = ["--topic" if word == "-t" else word for word in words]
    name = " ".join(spelled[:2])
    if name in _ALIKE:
        return schemas()[_ALIKE[name]]
    fitting = [name for name in schemas() if {*name.split()} <= {*spelled}]
    # `info --losses -t TOPIC` shows losses.
    return schemas()[max(fitting, key=lambda name: (len(name.split()), name != "info --topic"))]


def misfit(value: Any, schema: Any, place: str = "$") -> str:
    """Where a value does not fit; empty if it does."""
    if isinstance(schema, str):
        of = schema.removesuffix("?")
        if (
            of == "any"
            or (value is None and of != schema)
            or (of == "num" and value in _NO_NUMBERS)
        ):
            return ""
        is_one = isinstance(value, _TYPES[of]) and (of == "bool" or not isinstance(value, bool))
        return "" if is_one else f"{place} is {value!r}, not {schema}"
    if isinstance(schema, list):
        if not isinstance(value, list):
            return f"{place} is no list"
        each = (misfit(one, schema[0], f"{place}[{n}]") for n, one in enumerate(value))
        return next(filter(None, each), "")
    if "any of" in schema:
        first, other = schema["any of"]
        other = [first] if other == ["same"] else other
        return misfit(value, first, place) and misfit(value, other, place)
    if "?" in schema:
        return "" if value is None else misfit(value, schema["?"], place)
    if not isinstance(value, dict):
        return f"{place} is no object"
    optional = {k for k, v in schema.items() if isinstance(v, dict) and "optional" in v}
    if missing := schema.keys() - value.keys() - optional - {"*"}:
        return f"{place} lacks {sorted(missing)}"
    for key, one in value.items():
        if key not in schema and "*" not in schema:
            return f"{place} has {key!r}"
        of = schema.get(key, schema.get("*"))
        of = of["optional"] if key in optional else of
        if found := misfit(one, of, f"{place}.{key}"):
            return found
    return ""
