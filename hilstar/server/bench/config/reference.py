"""The reference of the bench file, docs/bench-file.md: `python -m
hilstar.server.bench.config.reference` prints it.

All of it comes from the classes of the tables: keys, types, units, limits and defaults, and their
meanings from the comments `#:` above or beside each key, which may end in a default in words
(`Default: the middle of the screen`). What is to be said of a whole table stands in bench-file.md
beside this file.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta
from msgspec.structs import FieldInfo

from hilstar.basics.toml_tables import plain
from hilstar.display.quantisers import QUANTISERS
from hilstar.server.bench.config.bench_config import TYPE_WORDS, BenchConfig
from hilstar.server.bench.config.render import DEFAULT_BRIGHTEST_V_MAG, MAX_JUDGED_FRAMES
from hilstar.server.bench.config.values import MAX_NUMBER, MIN_POSITIVE

# The unit that the end of a key's name says, the longest end first.
UNITS = {
    "_mag_arcsec2": "mag/arcsec2",
    "_e_per_s_px": "e-/s in a pixel",
    "_per_cm2_s": "per cm2 and second",
    "_e_per_dn": "e-/DN",
    "_electrons_across": "e-",
    "_e_per_s": "e-/s",
    "_deg_s": "deg/s",
    "_km_s": "km/s",
    "_per_px": "e-",
    "_jyear": "Julian year",
    "_mag": "mag",
    "_deg": "deg",
    "_dn": "DN",
    "_ev": "eV",
    "_ff": "fF",
    "_hz": "Hz",
    "_mm": "mm",
    "_ms": "ms",
    "_px": "px",
    "_um": "um",
    "_e": "e-",
    "_k": "K",
    "_s": "s",
}
FILLED_IN = {
    "QUANTISERS": "".join(
        f'`"{name}"`: {quantiser.words} ' for name, quantiser in QUANTISERS.items()
    ),
    "MAX_JUDGED_FRAMES": f"{MAX_JUDGED_FRAMES}",
    "DEFAULT_BRIGHTEST_V_MAG": f"{DEFAULT_BRIGHTEST_V_MAG}",
}
WORDS = Path(__file__).with_name("bench-file.md")  # what the page says beside the tables of keys


def page() -> str:
    """The whole page."""
    head, *sections = re.split(
        r"^## `\[(.*)\]`$", WORDS.read_text(encoding="utf-8"), flags=re.MULTILINE
    )
    notes = dict(zip(sections[::2], sections[1::2], strict=True))
    return "\n".join(
        [
            f"{head.rstrip()}\n",
            *(
                section(name, table, notes.get(name, ""))
                for name, table in tables_of(BenchConfig, "")
            ),
        ]
    )


def tables_of(table: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Each table inside `table` by its name in the file, outer ones first: ("tracker", Tracker),
    ("tracker.detector", ...).
    """
    for field in msgspec.structs.fields(table):
        inner = table_in(field.type)
        if inner is not None:
            yield prefix + field.name, inner
            yield from tables_of(inner, f"{prefix}{field.name}.")


def table_in(hint: Any) -> type[msgspec.Struct] | None:
    """The table that a key is, or may be (`X | None`); None for any other key."""
    kind = plain(hint)
    if is_optional(kind):
        parts = [part for part in get_args(kind) if part is not type(None)]
    else:
        parts = [kind]
    only = parts[0] if len(parts) == 1 else None
    if isinstance(only, type) and issubclass(only, msgspec.Struct):
        return only
    return None


def section(name: str, table: Any, notes: str) -> str:
    """A table of the file: what it is for, its keys, and what else there is to know."""
    hints = get_type_hints(table, include_extras=True)
    meanings = meanings_of(table)
    keys = [field for field in msgspec.structs.fields(table) if table_in(field.type) is None]
    rows = [row(field, hints[field.name], meanings[field.name]) for field in keys]
    lines = [
        f"## `[{name}]`",
        "",
        inspect.getdoc(table) or "",
        "",
        "| key | value | default | meaning |",
        "|---|---|---|---|",
    ]
    return "\n".join([*lines, *rows, "", *([notes.strip(), ""] if notes else [])])


def meanings_of(table: type) -> dict[str, str]:
    """The meaning of each key of a table: the comments `#:` above it and beside it."""
    source = textwrap.dedent(inspect.getsource(table))
    lines, meanings, (definition,) = source.splitlines(), {}, ast.parse(source).body
    for key in definition.body if isinstance(definition, ast.ClassDef) else []:
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name):
            first = key.lineno - 1
            while lines[first - 1].lstrip().startswith("#:"):
                first -= 1
            notes = []
            for line in lines[first : key.end_lineno]:
                if "#:" in line:
                    notes.append(line.partition("#:")[2].strip())
            meaning = " ".join(notes)
            for name, filling in FILLED_IN.items():
                meaning = meaning.replace(f"{{{name}}}", filling)
            meanings[key.target.id] = meaning
    return meanings


def row(field: FieldInfo, hint: Any, told: str) -> str:
    """A key: its name, what it may hold, what it holds otherwise, and what it means by its
    comment (see `meanings_of`).
    """
    meaning, _, default = told.partition(" Default: ")
    if field.required:
        default = "**required**"
    return (
        f"| `{field.name}` | {value_text(field.name, hint)} |"
        f" {default or f'`{toml(field.default)}`'} | {meaning} |"
    )


def notes_of(hint: Any) -> list[Meta]:
    """The notes in the annotations of a type, inner ones first; those of `X | None` are X's too."""
    kind, *notes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    metas: list[Meta] = []
    if is_optional(kind):
        for choice in get_args(kind):
            if get_origin(choice) is Annotated:
                metas += notes_of(choice)
    return metas + [note for note in notes if isinstance(note, Meta)]


def is_optional(kind: Any) -> bool:
    """Whether a type is `X | None`."""
    return type(None) in get_args(kind)


def value_text(name: str, hint: Any) -> str:
    """The values of a key: its choices, or its form, limits and unit."""
    kind = plain(hint)
    notes = notes_of(hint)
    if is_optional(kind):
        choices = tuple(plain(choice) for choice in get_args(kind) if choice is not type(None))
    else:
        choices = ()
    if len(choices) == 1:
        (kind,) = choices
    if get_origin(kind) is Literal:
        return ", ".join(f"`{toml(choice)}`" for choice in get_args(kind))
    form = next((note.extra["form"] for note in notes if note.extra and "form" in note.extra), None)
    if form:
        forms = f"`{form}`"
    else:
        forms = " or ".join(
            TYPE_WORDS[choice.__name__] for choice in choices or get_args(kind) or (kind,)
        )
    unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
    return ", ".join(part for part in (forms, limits_text(notes), unit) if part)


def limits_text(notes: list[Meta]) -> str:
    """The limits of a number; those that only keep arithmetic within float64 are not told."""
    low = next((note.ge for note in notes if note.ge is not None), None)
    high = next((note.le for note in notes if note.le is not None), None)
    if low is None:
        return ""
    if low == MIN_POSITIVE:
        above = "above 0"
    else:
        above = f"{low:g} or more"
    if high is None or high >= MAX_NUMBER:
        return above
    return f"{low:g} to {high:.12g}"


def toml(value: Any) -> str:
    """A value as a bench file has it."""
    if isinstance(value, float):
        return f"{value:.15g}"
    if isinstance(value, tuple):
        return f"[{', '.join(map(toml, value))}]"
    return msgspec.json.encode(value).decode()


if __name__ == "__main__":
    print(page(), end="")
