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

    #: `"zmq"`: packets or JSON over ZeroMQ. `"serial"`: COBS frames over a serial line. `"udp"`: a
    #: packet or JSON in each datagram. `"vizard"`: Basilisk's Vizard stream, and `"42"`: the text
    #: stream of NASA's 42; their attitude is the body's (`[tracker] q_body_to_cam`). `"scpi"`:
    #: `SKY:ATT` and `SKY:RATE` of a test stand (`hilstar serve --scpi`), with no other key of a
    #: source.
    source: Literal["zmq", "serial", "udp", "vizard", "42", "scpi"] = "zmq"
    #: ZeroMQ and Vizard: the address to which hilstar's SUB socket connects. `tcp://HOST:PORT`,
    #: where HOST is an IPv4 address, an IPv6 address in brackets, or a name (when hilstar binds
    #: also `*`, and PORT may be `*` for a free one, which is then reported), or
    #: `ipc:///WHOLE/PATH`. Basilisk has no keys: its endpoint is on this machine. UDP:
    #: `udp://ADDRESS:PORT`, another way to write `bind`. 42: where its socket is, when it is the
    #: server. Default: `tcp://127.0.0.1:5560`; of Vizard `tcp://127.0.0.1:5570`, in lockstep
    #: `tcp://127.0.0.1:5556`; of 42 `tcp://127.0.0.1:10001`
    endpoint: str | None = None
    #: ZeroMQ, Vizard and 42: `true` when hilstar binds and the sender connects. UDP: the address
    #: and port listened on, `"ADDRESS"`, `"ADDRESS:PORT"` or `"[IPv6]:PORT"` (port 0: a free one,
    #: which is reported). Default: `false`; `true` in lockstep; `"127.0.0.1:5560"` over UDP
    bind: bool | str | None = None
    #: UDP, and 42 where hilstar binds: who may send: addresses and networks, such as
    #: `["192.168.1.20", "fd00::/64"]`. What others send is counted, and never answered. Default:
    #: this machine; required where `bind` is not loopback
    allow: Annotated[tuple[str, ...], Meta(extra={"form": '["ADDRESS", ...]'})] = ()
    #: ZeroMQ: `true` for a REP socket. Each request is one attitude and gets one frame and one
    #: reply, at whatever speed the sender has. Vizard: `true` for Basilisk's live stream instead of
    #: its broadcast; hilstar stands in Vizard's place, and Basilisk's cameras get pictures of the
    #: virtual tracker. 42: `true` to acknowledge each message once its frame is out, so that 42 may
    #: run as fast as it can.
    lockstep: bool = False
    #: Vizard: the name of the spacecraft that carries the tracker. 42: its number, such as
    #: `"SC[0]"`. Default: the only one that is there; `"SC[0]"`
    spacecraft: str | int | None = None
    #: Vizard: `true` when the spacecraft's velocity aberrates the stars: 5 arcsec in low orbit. It
    #: adds to `[sky] observer_velocity_km_s`, which is then that of the origin of Basilisk's frame.
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
    #: `"estimated"`: the offset of the sender's clock is estimated. `"shared"`: the sender runs on
    #: this machine and `t_ns` is its CLOCK_MONOTONIC; nothing is estimated, and latency is
    #: absolute. `"unix"`: `t_ns` is Unix time of a machine that PTP or NTP disciplines, as this
    #: one; the offset is that of this machine's own clock, with the error that its kernel states.
    clock: Literal["estimated", "shared", "unix"] = "estimated"
    #: The age at which an attitude counts as stale; below half of that it counts as fresh again.
    stale_after_ms: NotNegative = 250.0
    #: How long the rate of the newest sample carries the attitude on; after that the attitude
    #: stands still.
    max_extrapolation_ms: NotNegative = 250.0
    #: What is shown while the attitude is stale. `"hold"`: the last attitude. `"blank"`: no stars.
    on_stale: Literal["hold", "blank"] = "hold"
    #: A packet or a log entry with a faster rate is refused (reason `rate`; rates in packets are
    #: rad/s), and two samples that would need a faster turn between them are a jump, never a turn.
    max_rate_deg_s: Annotated[float, Meta(ge=1e-3, le=1e9)] = 60.0
    #: How the newest attitude is carried on to the moment of light. `"rate"`: by its rate, which is
    #: exact for a steady turn and amplifies jitter from about 0.3 / age on (15 Hz at 20 ms).
    #: `"auto"`: a steady turn as before, and of the jitter as much as the last second's samples
    #: show to go on ([On time](on-time.md#prediction-and-jitter)).
    prediction: Literal["rate", "auto"] = "rate"
    #: Rates that are not those of the packets' own quaternions (in deg/s, of the wrong sign, axes
    #: or frame, by a factor, late, or zero) are reported (`rates-wrong`), and quaternions that
    #: rates show to be of another convention (`convention-wrong`). `"use-quaternions"`: and the sky
    #: is drawn by the quaternions' own turn until the rates are right. `"warn"`: they are used all
    #: the same. `"off"`: nothing is compared. At rest nothing can be told. A log's rates are used
    #: only where they fit its attitudes.
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
    place, allowed = (
        bound_place(settings.bind, settings.port, settings.endpoint),
        AllowedSenders(settings.allow),
    )
    if not allowed and not place.loopback:
        raise InputError(
            f"{place} is open to other machines, and allow does not say which may send;"
            f" {ALLOW_FORM}"
        )
    return place, allowed


def nasa42_road(settings: AttitudeSettings) -> tuple[int, AllowedSenders]:
    """The number of 42's spacecraft, and who may connect. Raises InputError as `udp_road` does."""
    place, allowed = parse_endpoint(settings.address), AllowedSenders(settings.allow)
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
