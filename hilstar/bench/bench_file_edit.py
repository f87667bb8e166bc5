"""One key of a bench file set, and everything else kept, comments included."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence


def with_key(
    text: str, table: str, key: str, value: float | str | bool | Sequence[float], instead_of: tuple[str, ...] = ()
) -> str:
    """TOML `text` with `key` of a plain `[table]` set: its line replaced, or that of a key in `instead_of`, or one added.

    Where the table is written in another TOML form, the result means something else: parse it again to see.
    """
    line = f"{key} = {json.dumps(value)}"  # of numbers, truth values and plain text, TOML writes the same
    header = re.search(rf"^[ \t]*\[{table}\][^\n]*\n?", text, re.MULTILINE)
    if header is None:
        return f"{text.rstrip()}\n\n[{table}]\n{line}\n".lstrip()
    following = re.search(r"^[ \t]*\[", text[header.end() :], re.MULTILINE)
    end = header.end() + following.start() if following else len(text)
    names = "|".join((key, *instead_of))
    there = re.compile(rf"^([ \t]*)(?:{names})[ \t]*=[^\n#]*?([ \t]*#[^\n]*)?$", re.MULTILINE)
    body, count = there.subn(rf"\g<1>{line}\g<2>", text[header.end() : end], count=1)
    head = text[: header.end()].removesuffix("\n") + "\n"
    return head + (body if count else f"{line}\n{body}") + text[end:]
