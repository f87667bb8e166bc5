"""The link that a bench file names: one source of attitudes, one class."""

from __future__ import annotations

from pathlib import Path

from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.links import StreamLink
from hilstar.attitude.wire.serial_link import SerialLink
from hilstar.attitude.wire.udp.udp_link import UdpLink
from hilstar.attitude.wire.zmq_lockstep import ZmqLockstep
from hilstar.attitude.wire.zmq_stream import ZmqReceiver
from hilstar.bench.config import AttitudeSettings, BenchConfig
from hilstar.bench.config.road import udp_road
from hilstar.notices import Notices

AnyLink = StreamLink | ZmqLockstep


def link_keys(settings: AttitudeSettings, folder: Path) -> CurveKeys:
    """The CURVE key files that the bench file names; paths are relative to it."""
    names = (settings.curve_secret_key, settings.curve_server_key, settings.allowed_clients)
    return CurveKeys(*(None if name is None else folder / name for name in names))


def open_link(config: BenchConfig, folder: Path, notices: Notices | None = None) -> AnyLink:
    """The link that the bench file in `folder` names. Raises InputError if it cannot be opened."""
    settings = config.attitude
    if settings.source == "serial":
        return SerialLink(str(settings.port), settings.baud, notices)
    if settings.source == "udp":
        return UdpLink(*udp_road(settings), notices)
    keys = link_keys(settings, folder)
    if settings.lockstep:
        return ZmqLockstep(settings.endpoint, bind=settings.bind is not False, keys=keys, notices=notices)
    return ZmqReceiver(settings.endpoint, bind=settings.bind is True, keys=keys, notices=notices)
