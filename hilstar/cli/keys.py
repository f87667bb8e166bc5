"""hilstar keys: CURVE keys for ZeroMQ beyond loopback."""

from pathlib import Path

from hilstar.basics.files import check_directory
from hilstar.cli.declare import struct
from hilstar.cli.options import json_option, output_option
from hilstar.server.console.terminal import print_found, say


@struct
class KeysOptions:
    """The options of `hilstar keys`."""

    output: Path = output_option("DIR", "Directory for the keys.", default=Path("hilstar-keys"))
    as_json: bool = json_option()


def keys(options: KeysOptions) -> None:
    """Make CURVE keys for ZeroMQ: non-loopback endpoints require them."""
    from hilstar.attitude.wire.keys import make_keys

    check_directory("-o", options.output)
    written = [str(path) for path in make_keys(options.output)]
    print_found(options.as_json, {"written": written}, written)
    say("the side that binds needs server.key_secret and allowed_clients")
    say("the side that connects needs client.key_secret and server.key")
