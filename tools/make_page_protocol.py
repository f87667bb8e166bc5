"""Makes hilstar/server/console/page/protocol.js, the constants that the page shares with its
server. Run without arguments.
"""

from __future__ import annotations

import json
from pathlib import Path

import msgspec

from hilstar.server.console import protocol

OUTPUT = (
    Path(__file__).resolve().parents[1] / "hilstar" / "server" / "console" / "page" / "protocol.js"
)
HEAD = (
    "// What the page and its server share. Made from console/protocol.py by"
    " tools/make_page_protocol.py: edit it there.\n"
)


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
    return (
        HEAD
        + "\n"
        + "".join(
            f"export const {name} = {json.dumps(value)};\n" for name, value in constants.items()
        )
    )


if __name__ == "__main__":
    OUTPUT.write_text(page_protocol(), encoding="utf-8")
