"""Makes hilstar/server/console/page/protocol.js, the constants that the page shares with its
server. Run without arguments.
"""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

from hilstar.server.console import protocol
from hilstar.server.console.page_figures import FIGURES, HIDDEN, PageFigure

OUTPUT = (
    Path(__file__).resolve().parents[1] / "hilstar" / "server" / "console" / "page" / "protocol.js"
)
HEAD = (
    "// What the page and its server share. Made from console/protocol.py and page_figures.py by"
    " tools/make_page_protocol.py: edit it there.\n"
)
# What of a figure's row the page has: how it is written.
SHOWN = ("panel", "name", "key", "unit", "digits", "form", "text", "none", "shade")


def page_protocol() -> str:
    """The module's text."""
    constants = {
        "SUBPROTOCOL": protocol.SUBPROTOCOL,
        "TOKEN_PROTOCOL": protocol.TOKEN_PROTOCOL,
        "GIVES_WAY": protocol.GIVES_WAY,
        "HISTORY_S": protocol.HISTORY_S,
        "KEPT_EVENTS": protocol.KEPT_EVENTS,
        "SWITCHES": [*protocol.SWITCHES, "ledger"],
        "MESSAGE_KEYS": [field.name for field in msgspec.structs.fields(protocol.PageText)],
        "STAR": {
            field.name: place
            for place, field in enumerate(msgspec.structs.fields(protocol.StarMark))
        },
    }
    lines = [f"export const {name} = {json.dumps(value)};" for name, value in constants.items()]
    lines.append("export const FIGURES = [")
    lines += [f"  {figure_row(figure)}," for figure in FIGURES if figure.panel != HIDDEN]
    lines.append("];")
    return HEAD + "\n" + "\n".join(lines) + "\n"


def figure_row(figure: PageFigure) -> str:
    """A figure's row as the page has it, in JSON."""
    return json.dumps({name: getattr(figure, name) for name in SHOWN})


if __name__ == "__main__":
    OUTPUT.write_text(page_protocol(), encoding="utf-8")
