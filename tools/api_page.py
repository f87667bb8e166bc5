"""The reference at the end of python-api.md, from signatures and docstrings; the text before it
is written by hand.
"""

from __future__ import annotations

import inspect
import pydoc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
MARK = "<!-- what follows is generated: python tools/make_pages.py -->\n"
LINE_CHARACTERS = 100
# Each section's objects, and of a class the members that users call.
SECTIONS: dict[str, dict[str, tuple[str, ...]]] = {
    "Benches and frames": {
        "hilstar.load": (),
        "hilstar.Bench": ("frame", "draw", "simulate", "verify", "budget", "losses_mag", "close"),
        "hilstar.Frame": ("to_table", "wcs", "save"),
        "hilstar.Drawn": (),
        "hilstar.assess": (),
    },
    "Comparison of two skies": {
        "hilstar.testing.assert_same_sky": (),
        "hilstar.testing.compare": (),
    },
    "Rotations": {
        f"hilstar.rotation.{name}": ()
        for name in (
            "from_radec_roll_deg",
            "to_radec_roll_deg",
            "to_matrix",
            "multiply",
            "angle_between_rad",
            "slerp",
            "propagate",
        )
    },
    "Sender": {
        "hilstar.Sender": ("endpoint", "status", "wait", "send", "close"),
        "hilstar.attitude.wire.packet.Status": (),
    },
    "Packets": {
        "hilstar.attitude.wire.packet.AttitudeSample": (),
        "hilstar.attitude.wire.packet.encode": (),
    },
    "Errors": {"hilstar.HilstarError": (), "hilstar.InputError": (), "hilstar.MachineError": ()},
}
# made by others: how they are put together is nobody's call
FROM_LOAD = {"hilstar.Bench", "hilstar.Frame", "hilstar.Drawn"}


def page() -> str:
    """The page: its text as it stands, and the reference as it is now."""
    text = (DOCS / "python-api.md").read_text(encoding="utf-8").partition(MARK)[0]
    return text + MARK + "\n" + "\n".join(_reference())


def _reference() -> Iterator[str]:
    for title, names in SECTIONS.items():
        yield f"## {title}\n"
        for name, members in names.items():
            found = pydoc.locate(name)
            yield from _entry(
                "###", name, found, "" if name in FROM_LOAD else signature(name, found)
            )
            for member in members:
                part = inspect.getattr_static(found, member)
                yield from _entry(
                    "####", f"{name.rpartition('.')[2]}.{member}", part, signature(member, part)
                )


def _entry(level: str, name: str, found: Any, code: str) -> Iterator[str]:
    yield f"{level} {name}\n"
    if code:
        yield f"```text\n{code}\n```\n"
    yield f"{_with_fences(inspect.getdoc(found) or '')}\n"


def _with_fences(text: str) -> str:
    """A docstring whose examples, each from its first prompt to a blank line, stand in fences."""
    paragraphs = text.split("\n\n")
    return "\n\n".join(
        f"```text\n{part}\n```" if part.startswith(">>> ") else part for part in paragraphs
    )


def signature(name: str, found: Any) -> str:
    """How it is called, in one line or a parameter a line; of a property its type; "" where
    nobody calls it.
    """
    short = name.rpartition(".")[2]
    if isinstance(found, property):
        returned = inspect.get_annotations(found.fget)["return"] if found.fget else ""
        return f"{short}: {returned}"
    if inspect.isclass(found) and issubclass(found, Exception):
        return ""
    shown = inspect.signature(found)
    returns = "" if inspect.isclass(found) else f" -> {shown.return_annotation}"
    given = [each for each in shown.parameters.values() if each.name != "self"]
    parameters = [_parameter(each) for each in given]
    first = next((k for k, each in enumerate(given) if each.kind is each.KEYWORD_ONLY), None)
    if first is not None:
        parameters.insert(first, "*")
    line = f"{short}({', '.join(parameters)}){returns}"
    if len(line) <= LINE_CHARACTERS:
        return line
    return f"{short}(\n" + "".join(f"    {each},\n" for each in parameters) + f"){returns}"


def _parameter(each: inspect.Parameter) -> str:
    default = (
        ""
        if each.default is each.empty
        else f" = {getattr(each.default, '__name__', None) or repr(each.default)}"
    )
    return f"{each.name}: {each.annotation}{default}"
