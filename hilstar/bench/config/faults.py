"""[faults]."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from hilstar.toml_tables import Table


class FaultSettings(Table, frozen=True):
    """Where faults come from beside a scenario file: a second ZeroMQ stream, of JSON (see [faults](faults.md)).

    As with the attitude, an endpoint that is not loopback is refused without CURVE keys (`hilstar keys`).
    """

    endpoint: Annotated[
        str | None,
        Meta(
            description="The address to which hilstar's SUB socket connects, as in `[attitude]`: `tcp://HOST:PORT` or "
            "`ipc:///WHOLE/PATH`. Without it there is no stream of faults.",
            extra={"default": "none"},
        ),
    ] = None
    bind: Annotated[bool, Meta(description="`true` when hilstar binds and the senders connect.")] = False
    curve_secret_key: Annotated[
        str | None, Meta(description="The file of this side's secret key.", extra={"default": "none"})
    ] = None
    curve_server_key: Annotated[
        str | None,
        Meta(description="The file of the binding side's public key, when hilstar connects.", extra={"default": "none"}),
    ] = None
    allowed_clients: Annotated[
        str | None,
        Meta(description="The directory with the public keys that may connect, when hilstar binds.", extra={"default": "none"}),
    ] = None
