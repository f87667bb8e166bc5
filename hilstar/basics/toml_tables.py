"""Tables of a TOML file as frozen structs, and a wrong one as one line for the person who wrote it.

The line says table, key, value, and what is wanted, in the place of msgspec's own message.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, time
from pathlib import PurePath
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec

from hilstar.basics.errors import did_you_mean, shortened

# by length
EXAMPLES: dict[int, tuple[float, ...]] = {
    2: (1024, 1024),
    3: (0.0, 0.0, 0.0),
    4: (1.0, 0.0, 0.0, 0.0),
}


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of a TOML file; unknown keys are refused."""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file: its outermost table, the page that describes its keys, and the words for
    msgspec's types.
    """

    root: type[Table]
    reference: str
    type_words: dict[str, str]


def explained(message: str, tables: dict[str, Any], kind: Kind) -> str:
    """The line for msgspec's `message` about `tables`, a file as it was read."""
    try:
        return _explain(message, tables, kind)
    except (LookupError, TypeError, ValueError):
        # a key of the user's own with brackets or quotes in it
        return f"{shortened(message)}; see {kind.reference}"


def plain(hint: Any) -> Any:
    """A key's type without its limits and meaning."""
    if get_origin(hint) is Annotated:
        return get_args(hint)[0]
    return hint


def _explain(message: str, tables: dict[str, Any], kind: Kind) -> str:
    """msgspec's message ("... - at `$.tracker`") as table, key, value and advice."""
    fault, _, place = message.partition(" - at `$")
    names = [name for name in re.split(r"[.\[\]`]+", place) if name]
    unknown = re.search(r"unknown field `(.*)`", fault)
    if unknown:
        known = [field.name for field in _fields(kind.root, names)]
        advice = did_you_mean(unknown[1], known).strip() or f"known are {', '.join(known)}"
        return f"{_place(names)}unknown key {shortened(unknown[1])}; {advice}"
    missing = re.search(r"missing required field `(.*)`", fault)
    if missing:
        if names:
            name = f"key {missing[1]}"
        else:
            name = f"table [{missing[1]}]"
        return f"{_place(names)}the {name} is missing; add it (see {kind.reference})"
    *table, key = [name for name in names if not name.isdigit()]
    value: Any = tables
    for name in (*table, key):
        value = value[name]
    field = next(field for field in _fields(kind.root, table) if field.name == key)
    choices = _choices(plain(field.type))
    if choices and not isinstance(value, list):
        wanted = " or ".join(map(_toml, choices))
        return (
            f"{_place(table)}{key} = {_toml(value)};"
            f" {did_you_mean(value, map(str, choices))}{wanted} is wanted"
        )
    wanted = (
        fault.removeprefix("Expected ")
        .replace("`", "")
        .split(", got ")[0]
        .removesuffix(" | null")
        .replace(" | ", " or ")
    )
    for type_name, word in kind.type_words.items():
        wanted = re.sub(rf"\b{type_name}\b", word, wanted)
    return f"{_place(table)}{key} = {_toml(value)}; {wanted} is wanted{_such_as(field, value)}"


def _such_as(field: msgspec.structs.FieldInfo, value: Any) -> str:
    """An example of what the key takes, from what stands there: ", such as bits = 8"; "" where
    there is none.
    """
    if isinstance(value, str) and re.fullmatch(r"[+-]?\d+(\.\d+)?", value):
        return f", such as {field.name} = {shortened(value)}"
    kind = plain(field.type)
    # X of `X | None`
    parts = next(
        (part for part in (kind, *map(plain, get_args(kind))) if get_origin(part) is tuple), None
    )
    if parts is None:
        return ""
    kinds = [plain(kind) for kind in get_args(parts)]
    if Ellipsis in kinds:
        if isinstance(value, kinds[0]):
            return f", such as {field.name} = [{_toml(value)}]"
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool) and len(kinds) == 2:
        return f", such as {field.name} = [{_toml(value)}, {_toml(value)}]"
    if isinstance(field.default, tuple):
        example = field.default
    else:
        example = EXAMPLES[len(kinds)]
    return f", such as {field.name} = {_toml(list(example)).replace(',', ', ')}"


def toml_text(tables: Mapping[str, Any]) -> str:
    """A file of plain keys, then a table for each dictionary; None and empty tables are left
    unsaid.

    A list of lists stands row by row. Arrays and numbers of NumPy, and paths, are written as what
    they hold. Raises TypeError for a value that TOML does not have.
    """
    plain_keys: dict[str, Any] = {}
    tables_by_head: dict[str, Mapping[str, Any]] = {"": plain_keys}
    for name, value in tables.items():
        if isinstance(value, Mapping):
            tables_by_head[f"[{_key(name)}]\n"] = value
        else:
            plain_keys[name] = value
    texts = []
    for head, table in tables_by_head.items():
        stated = {key: value for key, value in table.items() if value is not None}
        if stated:
            rows = [f"{_key(key)} = {_rows(value)}\n" for key, value in stated.items()]
            texts.append(head + "".join(rows))
    return "\n".join(texts)


def _key(key: object) -> str:
    plain_key = re.fullmatch(r"[A-Za-z0-9_-]+", str(key))
    return str(key) if plain_key else json.dumps(str(key))


def _rows(value: Any) -> str:
    if isinstance(value, list) and value and isinstance(value[0], list):
        rows = ",\n    ".join(map(_written, value))
        return f"[\n    {rows},\n]"
    return _written(value)


def _written(value: Any) -> str:
    """A value as TOML writes it. A quantity is none: its key names the unit."""
    if hasattr(value, "tolist") and not hasattr(value, "unit"):
        value = value.tolist()
    match value:
        case bool() | str():
            return json.dumps(value)
        case int() | float():
            return repr(value)
        case PurePath():
            return json.dumps(str(value))
        case date() | time():
            return value.isoformat()
        case list() | tuple():
            return f"[{', '.join(map(_written, value))}]"
        case Mapping():
            given = {key: item for key, item in value.items() if item is not None}
            pairs = (f"{_key(key)} = {_written(item)}" for key, item in given.items())
            return f"{{ {', '.join(pairs)} }}"
    raise TypeError(
        f"{shortened(repr(value))}: write text, a number, true or false, or a list of them, in the"
        " unit that its key names"
    )


def _toml(value: Any) -> str:
    try:
        return shortened(msgspec.json.encode(value, enc_hook=str).decode())
    except (ValueError, OverflowError, TypeError, RecursionError):
        # a whole number of more than 64 bits
        return shortened(value)


def _choices(kind: Any) -> tuple[Any, ...]:
    """The values of a key that has choices, those of X where it is `X | None`; none of another
    key.
    """
    if type(None) in get_args(kind):
        parts = get_args(kind)
    else:
        parts = (kind,)
    literal = [plain(part) for part in parts if get_origin(plain(part)) is Literal]
    return tuple(choice for part in literal for choice in get_args(part))


def _place(names: list[str]) -> str:
    """The table of these names, and its number where it is one of a list."""
    if names and names[-1].isdigit():
        return f"[[{'.'.join(names[:-1])}]] number {int(names[-1]) + 1}: "
    return f"[{'.'.join(names)}] " if names else ""


def _fields(root: type[Table], names: list[str]) -> tuple[msgspec.structs.FieldInfo, ...]:
    table: Any = root
    # an index of a list of tables is no key
    for name in (name for name in names if not name.isdigit()):
        hint = plain({field.name: field.type for field in msgspec.structs.fields(table)}[name])
        table = (get_args(hint) or (hint,))[0]  # X in `X | None`
    return msgspec.structs.fields(table)
