"""hilstar keys: CURVE keys for ZeroMQ beyond loopback."""

from pathlib import Path
from typing import Annotated

from typer import Option

from hilstar.basics.files import check_directory
from hilstar.cli.options import Json
from hilstar.server.console.terminal import print_found, say


def keys(
    output: Annotated[
        Path, Option("-o", "--output", metavar="DIR", help="Directory for the keys.")
    ] = Path("hilstar-keys"),
    as_json: Json = False,
) -> None:
    """Make CURVE keys for ZeroMQ: non-loopback endpoints require them."""
    from hilstar.attitude.wire.keys import make_keys

    check_directory("-o", output)
    written = [str(path) for path in make_keys(output)]
    print_found(as_json, {"written": written}, written)
    say("the side that binds needs server.key_secret and allowed_clients")
    say("the side that connects needs client.key_secret and server.key")
