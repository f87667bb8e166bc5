"""The link that a bench file names, and the first attitude that comes over it."""

import math
import time
from dataclasses import replace
from pathlib import Path

from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.links import LockstepLink, PacketDecoder, StreamLink
from hilstar.attitude.wire.nasa42 import MessageReader, Nasa42Link, Nasa42Lockstep
from hilstar.attitude.wire.packet import AttitudeSample, Refusal, TimeReply, TimeRequest
from hilstar.attitude.wire.serial_link import SerialApart, SerialLink
from hilstar.attitude.wire.source import Mounting, SentAttitudes
from hilstar.attitude.wire.udp import UdpLink
from hilstar.attitude.wire.vizard import (
    DifferenceRates,
    Follower,
    StateUse,
    VizardLive,
    vizard_broadcast,
)
from hilstar.attitude.wire.zmq_links import ZmqApart, ZmqLockstep, ZmqReceiver
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.units import NS_PER_MS
from hilstar.server.bench.config import AttitudeSettings, BenchConfig
from hilstar.server.bench.config.attitude import FaultSettings, nasa42_road, udp_road
from hilstar.server.bench.config.bench_config import from_source

AnyLink = StreamLink | LockstepLink
POLL_MS = 50


def link_keys(settings: AttitudeSettings | FaultSettings, folder: Path) -> CurveKeys:
    """The CURVE key files that the bench file names; paths are relative to it."""
    names = (settings.curve_secret_key, settings.curve_server_key, settings.allowed_clients)
    return CurveKeys(*(None if name is None else folder / name for name in names))


def open_link(
    config: BenchConfig, folder: Path, notices: Notices | None = None, *, apart: bool = False
) -> AnyLink:
    """The link that the bench file in `folder` names. Raises InputError if it cannot be opened.

    With `apart`, what the kernel does not stamp is read and stamped by a process of its own:
    OpenGL's calls hold Python's lock, and a thread of a process that draws reads a packet some
    milliseconds late.
    """
    settings = config.attitude
    sent = SentAttitudes(settings.convention, Mounting(config.tracker.q_body_to_cam))
    if settings.source == "serial":
        return (SerialApart if apart else SerialLink)(
            str(settings.port), settings.baud, notices, sent=sent
        )
    if settings.source in {"udp", "scpi"}:
        link = UdpLink(*udp_road(settings), notices, sent=sent)
        # hilstar's own process sends the packets: nobody else has a convention
        if settings.source == "scpi":
            link.conventions = replace(link.conventions, source="SCPI", of_packets=False)
        return link
    if settings.source == "vizard":
        return _open_vizard(config, notices, apart=apart)
    if settings.source == "42":
        return _open_42(config, notices)
    keys = link_keys(settings, folder)
    if settings.lockstep:
        return ZmqLockstep(
            settings.address, bind=settings.bind is not False, keys=keys, notices=notices, sent=sent
        )
    decoder = PacketDecoder(sent)
    receiver = ZmqReceiver(
        settings.address, bind=settings.bind is True, keys=keys, notices=notices, decoder=decoder
    )
    return ZmqApart(receiver, notices) if apart else receiver


def _open_vizard(config: BenchConfig, notices: Notices | None, *, apart: bool) -> AnyLink:
    settings = config.attitude
    rates = DifferenceRates(
        round(settings.stale_after_ms * NS_PER_MS), math.radians(settings.max_rate_deg_s)
    )
    if settings.spacecraft is None:
        name = None
    else:
        name = str(settings.spacecraft)
    mounting = Mounting(config.tracker.q_body_to_cam)
    taken: StateUse = (
        "state" if from_source(config) else "velocity" if settings.use_velocity else "attitude"
    )
    follower = Follower(name, mounting, rates, taken)
    if settings.lockstep:
        return VizardLive(
            settings.address, follower, bind=settings.bind is not False, notices=notices
        )
    broadcast = vizard_broadcast(
        settings.address, follower, bind=settings.bind is True, notices=notices
    )
    if apart:
        return ZmqApart(broadcast, notices)
    return broadcast


def _open_42(config: BenchConfig, notices: Notices | None) -> AnyLink:
    settings = config.attitude
    spacecraft, allowed = nasa42_road(settings)
    reader = MessageReader(spacecraft, Mounting(config.tracker.q_body_to_cam))
    kind = Nasa42Lockstep if settings.lockstep else Nasa42Link
    return kind(
        settings.address, reader, bind=settings.bind is True, allowed=allowed, notices=notices
    )


def first_attitude(link: StreamLink, patience_s: float) -> AttitudeSample:
    """The first attitude that arrives within `patience_s`. Raises InputError where none does,
    with the last refusal.
    """
    deadline_s = time.monotonic() + patience_s
    refused = ""
    while time.monotonic() < deadline_s:
        for arrival in link.receive(POLL_MS):
            match arrival.event:
                case AttitudeSample() as sample:
                    return sample
                # a sender may wait for the answer before it sends
                case TimeRequest(sequence, t1_ns) if link.two_way:
                    back = arrival.back or link.send
                    back(TimeReply(sequence, t1_ns, arrival.host_ns, time.monotonic_ns()))
                case Refusal(reason, detail):
                    refused = f"; the last message was refused ({reason}: {detail})"
    nothing = f"{link.endpoint}: no attitude within {patience_s:g} s"
    if refused:
        raise InputError(f"{nothing}{refused}")
    if link.trouble:
        raise InputError(f"{nothing}; {link.trouble.removeprefix(f'{link.endpoint}: ')}")
    raise InputError(f"{nothing}; start the sender, or give --wait S")
