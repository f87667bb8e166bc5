"""Tables of a TOML file as frozen structs, and a wrong one as one line for the person who wrote it.

The line says table, key, value, and what is wanted, in the place of msgspec's own message.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin

import msgspec

from hilstar.errors import shortened


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a TOML file; unknown keys are refused."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file: its outermost table, the page that describes its keys, and the words for msgspec's types."""

    root: type[Table]
    reference: str
    type_words: dict[str, str]


def explained(message: str, tables: dict[str, Any], kind: Kind) -> str:
    """The line for msgspec's `message` about `tables`, a file as it was read."""
    try:
        return _explain(message, tables, kind)
    except (LookupError, TypeError, ValueError):  # a key of the user's own with brackets or quotes in it
        return f"{shortened(message)}; see {kind.reference}"


def plain(hint: Any) -> Any:
    """A key's type without its limits and meaning."""
    return get_args(hint)[0] if get_origin(hint) is Annotated else hint


def _explain(message: str, tables: dict[str, Any], kind: Kind) -> str:
    """msgspec's message ("... - at `$.tracker`") as table, key, value and advice."""
    fault, _, place = message.partition(" - at `$")
    names = [name for name in re.split(r"[.\[\]`]+", place) if name]
    unknown = re.search(r"unknown field `(.*)`", fault)
    if unknown:
        known = [field.name for field in _fields(kind.root, names)]
        close = difflib.get_close_matches(unknown[1], known, n=1)
        advice = f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
        return f"{_place(names)}unknown key {shortened(unknown[1])}; {advice}"
    missing = re.search(r"missing required field `(.*)`", fault)
    if missing:
        name = f"key {missing[1]}" if names else f"table [{missing[1]}]"
        return f"{_place(names)}the {name} is missing; add it (see {kind.reference})"
    wanted = fault.removeprefix("Expected ").replace("`", "").split(", got ")[0].removesuffix(" | null")
    for type_name, word in kind.type_words.items():
        wanted = re.sub(rf"\b{type_name}\b", word, wanted)
    table, key = [n for n in names if not n.isdigit()][:-1], [n for n in names if not n.isdigit()][-1]
    if fault.startswith("Invalid enum"):
        wanted = " or ".join(f'"{choice}"' for choice in _choices(_fields(kind.root, table), key))
    value: Any = tables
    for name in (*table, key):
        value = value[name]
    return f"{_place(table)}{key} = {_toml(value)}; {wanted} is wanted"


def _toml(value: Any) -> str:
    try:
        return shortened(msgspec.json.encode(value, enc_hook=str).decode())
    except (ValueError, OverflowError, TypeError, RecursionError):  # a whole number of more than 64 bits
        return shortened(value)


def _choices(fields: tuple[msgspec.structs.FieldInfo, ...], key: str) -> tuple[str, ...]:
    kinds = {field.name: field.type for field in fields}
    kind = plain(kinds[key])
    # Of `X | None`, those of X: no file has a None.
    return tuple(choice for part in (get_args(kind) if type(None) in get_args(kind) else (kind,)) for choice in get_args(part))


def _place(names: list[str]) -> str:
    return f"[{'.'.join(names)}] " if names else ""


def _fields(root: type[Table], names: list[str]) -> tuple[msgspec.structs.FieldInfo, ...]:
    table: Any = root
    for name in names:
        hint = plain({field.name: field.type for field in msgspec.structs.fields(table)}[name])
        table = (get_args(hint) or (hint,))[0]  # of `X | None`: X
    return msgspec.structs.fields(table)
