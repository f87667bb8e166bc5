"""The tables of the streams: [attitude], with the checks of its keys for each kind of link, and
[faults].
"""

from typing import Annotated, Literal

from msgspec import Meta

from hilstar.attitude.wire.endpoint import (
    ALLOW_FORM,
    AllowedSenders,
    UdpPlace,
    bound_place,
    parse_endpoint,
)
from hilstar.attitude.wire.source import HILSTARS, Convention
from hilstar.basics.errors import InputError
from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.values import NotNegative

ENDPOINTS = {
    ("zmq", False): "tcp://127.0.0.1:5560",
    ("zmq", True): "tcp://127.0.0.1:5560",
    # where Basilisk broadcasts, and where it looks for Vizard
    ("vizard", False): "tcp://127.0.0.1:5570",
    ("vizard", True): "tcp://127.0.0.1:5556",
    ("42", False): "tcp://127.0.0.1:10001",  # from 42's own Inp_IPC.txt
    ("42", True): "tcp://127.0.0.1:10001",
}


# Whose senders write hilstar's packets or JSON themselves, and so may have another convention.
PACKET_SOURCES = ("zmq", "serial", "udp")


class AttitudeSettings(Table, frozen=True):
    """Where the attitude comes from, and what is shown without one."""

    #: `"zmq"` and `"udp"`: packets or JSON. `"serial"`: COBS frames. `"vizard"` (Basilisk) and
    #: `"42"`: a body's attitude ([sources](sources.md)). `"scpi"`: a [test stand](scpi.md).
    source: Literal["zmq", "serial", "udp", "vizard", "42", "scpi"] = "zmq"
    #: Where hilstar's SUB connects: `tcp://HOST:PORT` (bound also `*`) or `ipc:///WHOLE/PATH`. UDP:
    #: `udp://ADDRESS:PORT`, as `bind`. 42: its socket, as the server. Default:
    #: `tcp://127.0.0.1:5560`; of Vizard `tcp://127.0.0.1:5570`, in lockstep `tcp://127.0.0.1:5556`;
    #: of 42 `tcp://127.0.0.1:10001`
    endpoint: str | None = None
    #: `true` when hilstar binds and the sender connects. UDP: what it listens on, `"ADDRESS"`,
    #: `"ADDRESS:PORT"` or `"[IPv6]:PORT"` (port 0: any). Default: `false`; `true` in lockstep;
    #: `"127.0.0.1:5560"` over UDP
    bind: bool | str | None = None
    #: UDP, and 42 where hilstar binds: addresses and networks that may send, such as
    #: `["192.168.1.20", "fd00::/64"]`. Default: this machine; required where `bind` is not loopback
    allow: Annotated[tuple[str, ...], Meta(extra={"form": '["ADDRESS", ...]'})] = ()
    #: ZeroMQ: a REP socket; each request is one attitude, one frame, one reply. Vizard: Basilisk's
    #: live stream, in Vizard's place. 42: each message is acknowledged when its frame is out.
    lockstep: bool = False
    #: Vizard: the name of the spacecraft that carries the tracker. 42: its number, such as
    #: `"SC[0]"`. Default: the only one that is there; `"SC[0]"`
    spacecraft: str | int | None = None
    #: Vizard: whether the spacecraft's velocity aberrates the stars (5 arcsec in low orbit), beside
    #: the origin's.
    use_velocity: bool = True
    convention: Convention = HILSTARS
    #: ZeroMQ: the file of hilstar's own secret key. Default: none
    curve_secret_key: str | None = None
    #: ZeroMQ: the file of the binding side's public key, when hilstar connects. Default: none
    curve_server_key: str | None = None
    #: ZeroMQ: the directory with the public keys that may connect, when hilstar binds. Default:
    #: none
    allowed_clients: str | None = None
    #: Serial: the device, such as `"/dev/ttyUSB0"`. UDP: the port, where `bind` has none. Default:
    #: none; required for serial
    port: str | int = ""
    baud: Annotated[int, Meta(ge=1, le=12_000_000)] = 115_200  #: Serial: the speed, 8N1.
    #: Serial and UDP: status packets sent back to the sender per second; 0 for none.
    status_hz: Annotated[float, Meta(ge=0, le=1000)] = 10.0
    #: Serial and UDP: ask the sender for its time. A sender that does not answer is followed by its
    #: packets alone.
    time_requests: bool = True
    #: `"estimated"`: the sender's clock is fitted. `"shared"`: `t_ns` is this machine's
    #: CLOCK_MONOTONIC. `"unix"`: Unix time of a machine disciplined by PTP or NTP
    #: ([time](attitude-in.md#time)).
    clock: Literal["estimated", "shared", "unix"] = "estimated"
    #: The age at which an attitude counts as stale; below half of that it counts as fresh again.
    stale_after_ms: NotNegative = 250.0
    #: How long the rate of the newest sample carries the attitude on; after that the attitude
    #: stands still.
    max_extrapolation_ms: NotNegative = 250.0
    #: What is shown while the attitude is stale. `"hold"`: the last attitude. `"blank"`: no stars.
    on_stale: Literal["hold", "blank"] = "hold"
    #: A faster rate is refused (reason `rate`; rates in packets are rad/s); two samples that would
    #: need a faster turn are a jump.
    max_rate_deg_s: Annotated[float, Meta(ge=1e-3, le=1e9)] = 60.0
    #: How the newest attitude is carried on to the moment of light. `"rate"`: by its rate.
    #: `"auto"`: with as much of its jitter as persists ([On
    #: time](on-time.md#prediction-and-jitter)).
    prediction: Literal["rate", "auto"] = "rate"
    #: Rates that are not the turn of the packets' own quaternions are reported.
    #: `"use-quaternions"`: the sky then follows the quaternions. `"warn"`: the rates. `"off"`:
    #: nothing is compared ([rates](attitude-in.md#rates)).
    check_rates: Literal["use-quaternions", "warn", "off"] = "use-quaternions"

    @property
    def address(self) -> str:
        """The endpoint, or where the source usually is; empty for one that has none."""
        return self.endpoint or ENDPOINTS.get((self.source, self.lockstep), "")


def check_road(settings: AttitudeSettings) -> None:
    """Refuse (InputError) keys of another road, and a road that lacks one."""
    source = settings.source
    if settings.lockstep and source not in {"zmq", "vizard", "42"}:
        raise InputError(
            'lockstep = true is for source = "zmq", "vizard" or "42"; leave one of them out'
        )
    if isinstance(settings.bind, str) and source != "udp":
        raise InputError(
            f'bind = "{settings.bind}" is for source = "udp"; write true or false, and the address'
            " in endpoint"
        )
    if settings.allow and source != "udp" and not (source == "42" and settings.bind is True):
        raise InputError(
            'allow is for source = "udp", and for "42" with bind = true; remove it (source ='
            f' "{source}")'
        )
    if source == "serial" and (not settings.port or isinstance(settings.port, int)):
        raise InputError('source = "serial" needs port; write port = "/dev/ttyUSB0" or the like')
    if settings.convention != HILSTARS and source not in PACKET_SOURCES:
        raise InputError(
            f'convention = {settings.convention}: source = "{source}" has a convention of its own;'
            " remove it"
        )
    if settings.spacecraft is not None and source not in {"vizard", "42"}:
        raise InputError(
            f'spacecraft is for source = "vizard" or "42"; remove it (source = "{source}")'
        )
    if source in {"vizard", "42"}:
        _check_simulation(settings, "Basilisk" if source == "vizard" else "42")
    if source in {"udp", "scpi"}:
        udp_road(settings)
    if source == "42":
        nasa42_road(settings)


def _check_simulation(settings: AttitudeSettings, name: str) -> None:
    for key in ("curve_secret_key", "curve_server_key", "allowed_clients"):
        if getattr(settings, key) is not None:
            raise InputError(
                f"{key}: {name} knows no keys; remove it, and write endpoint ="
                ' "tcp://127.0.0.1:PORT"'
            )
    if settings.clock != "estimated":
        raise InputError(
            f'clock = "{settings.clock}": {name} sends the time of its simulation; write clock ='
            ' "estimated"'
        )


def udp_road(settings: AttitudeSettings) -> tuple[UdpPlace, AllowedSenders]:
    """Where UDP is bound, and who may send. Raises InputError, also where an open address has no
    list of senders.

    For SCPI it is a free port on loopback, to which the process that speaks SCPI sends packets as
    any sender would.
    """
    if settings.source == "scpi":
        for key in ("endpoint", "bind", "port"):
            if getattr(settings, key) not in {None, ""}:
                raise InputError(
                    f'{key}: source = "scpi" has none; remove it, and give the address in --scpi'
                    " HOST:PORT"
                )
        if settings.clock != "estimated":
            raise InputError(
                f'clock = "{settings.clock}": SCPI\'s attitudes are stamped by this machine;'
                " remove it"
            )
        return bound_place("127.0.0.1:0", "", None), AllowedSenders(())
    place = bound_place(settings.bind, settings.port, settings.endpoint)
    allowed = AllowedSenders(settings.allow)
    if not allowed and not place.loopback:
        raise InputError(
            f"{place} is open to other machines, and allow does not say which may send;"
            f" {ALLOW_FORM}"
        )
    return place, allowed


def nasa42_road(settings: AttitudeSettings) -> tuple[int, AllowedSenders]:
    """The number of 42's spacecraft, and who may connect. Raises InputError as `udp_road` does."""
    place = parse_endpoint(settings.address)
    allowed = AllowedSenders(settings.allow)
    if settings.bind is True and not allowed and not place.loopback:
        raise InputError(
            f"{settings.address} is open to other machines, and allow does not say which may send;"
            f" {ALLOW_FORM}"
        )
    # links and packets take 12 ms, which no other source needs here
    from hilstar.attitude.wire.nasa42 import spacecraft_number

    return spacecraft_number(settings.spacecraft), allowed


class FaultSettings(Table, frozen=True):
    """Where faults come from beside a scenario file: a second ZeroMQ stream, of JSON (see
    [faults](faults.md)).
    """

    #: The address to which hilstar's SUB socket connects, as in `[attitude]`: `tcp://HOST:PORT` or
    #: `ipc:///WHOLE/PATH`. Without it there is no stream of faults. Default: none
    endpoint: str | None = None
    bind: bool = False  #: `true` when hilstar binds and the senders connect.
    curve_secret_key: str | None = None  #: The file of this side's secret key. Default: none
    #: The file of the binding side's public key, when hilstar connects. Default: none
    curve_server_key: str | None = None
    #: The directory with the public keys that may connect, when hilstar binds. Default: none
    allowed_clients: str | None = None
