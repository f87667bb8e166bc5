"""What msgspec says of a wrong table, as one line for the person who wrote it: table, key, value, and what is wanted."""

from __future__ import annotations

import difflib
import re
from typing import Annotated, Any, get_args, get_origin

import msgspec

from hilstar.bench.config.bench import BenchConfig
from hilstar.errors import shortened

TYPE_WORDS = {"float": "number", "int": "whole number", "str": "text", "object": "table", "bool": "true or false"}


def explained(message: str, tables: dict[str, Any]) -> str:
    """The line for msgspec's `message` about `tables`, the bench file as read."""
    try:
        return _explain(message, tables)
    except (LookupError, TypeError, ValueError):  # a key of the user's own with brackets or quotes in it
        return f"{shortened(message)}; see configs/README.md"


def plain(kind: Any) -> Any:
    """A key's type without its limits and meaning."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def _explain(message: str, tables: dict[str, Any]) -> str:
    """msgspec's message ("... - at `$.tracker`") as table, key, value and advice."""
    fault, _, place = message.partition(" - at `$")
    names = [name for name in re.split(r"[.\[\]`]+", place) if name]
    unknown = re.search(r"unknown field `(.*)`", fault)
    if unknown:
        known = [field.name for field in _fields(names)]
        close = difflib.get_close_matches(unknown[1], known, n=1)
        advice = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
        return f"{_place(names)}unknown key {shortened(unknown[1])}; {advice}"
    missing = re.search(r"missing required field `(.*)`", fault)
    if missing:
        name = f"key {missing[1]}" if names else f"table [{missing[1]}]"
        return f"{_place(names)}the {name} is missing; add it (see configs/README.md)"
    wanted = fault.removeprefix("Expected ").replace("`", "").split(", got ")[0]
    for type_name, word in TYPE_WORDS.items():
        wanted = re.sub(rf"\b{type_name}\b", word, wanted)
    table, key = [n for n in names if not n.isdigit()][:-1], [n for n in names if not n.isdigit()][-1]
    if fault.startswith("Invalid enum"):
        wanted = " or ".join(f'"{choice}"' for choice in _choices(table, key))
    value: Any = tables
    for name in (*table, key):
        value = value[name]
    return f"{_place(table)}{key} = {_toml(value)}; {wanted} is wanted"


def _toml(value: Any) -> str:
    try:
        return shortened(msgspec.json.encode(value, enc_hook=str).decode())
    except (ValueError, OverflowError, TypeError, RecursionError):  # a whole number of more than 64 bits
        return shortened(value)


def _choices(table: list[str], key: str) -> tuple[str, ...]:
    kinds = {field.name: field.type for field in _fields(table)}
    return get_args(plain(kinds[key]))


def _place(names: list[str]) -> str:
    return f"[{'.'.join(names)}] " if names else ""


def _fields(names: list[str]) -> tuple[msgspec.structs.FieldInfo, ...]:
    table: Any = BenchConfig
    for name in names:
        table = plain({field.name: field.type for field in msgspec.structs.fields(table)}[name])
    return msgspec.structs.fields(table)
