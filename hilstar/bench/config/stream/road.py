"""What the keys of [attitude] mean together: the road that an attitude comes on, and where UDP is bound."""

from __future__ import annotations

from hilstar.attitude.wire.endpoint import ALLOW_FORM, AllowedSenders, Place, bound_place, parse_endpoint
from hilstar.attitude.wire.nasa42 import spacecraft_number
from hilstar.bench.config.stream.attitude import AttitudeSettings
from hilstar.errors import InputError


def check_road(settings: AttitudeSettings) -> None:
    """Refuse (InputError) keys of another road, and a road that lacks one."""
    source = settings.source
    if settings.lockstep and source not in {"zmq", "vizard", "42"}:
        raise InputError('lockstep = true is for source = "zmq", "vizard" or "42"; leave one of them out')
    if isinstance(settings.bind, str) and source != "udp":
        raise InputError(f'bind = "{settings.bind}" is for source = "udp"; write true or false, and the address in endpoint')
    if settings.allow and source != "udp" and not (source == "42" and settings.bind is True):
        raise InputError(f'allow is for source = "udp", and for "42" with bind = true; remove it (source = "{source}")')
    if source == "serial" and (not settings.port or isinstance(settings.port, int)):
        raise InputError('source = "serial" needs port; write port = "/dev/ttyUSB0" or the like')
    if settings.spacecraft is not None and source not in {"vizard", "42"}:
        raise InputError(f'spacecraft is for source = "vizard" or "42"; remove it (source = "{source}")')
    if source in {"vizard", "42"}:
        _check_simulation(settings, "Basilisk" if source == "vizard" else "42")
    if source == "udp":
        udp_road(settings)
    if source == "42":
        nasa42_road(settings)


def _check_simulation(settings: AttitudeSettings, name: str) -> None:
    for key in ("curve_secret_key", "curve_server_key", "allowed_clients"):
        if getattr(settings, key) is not None:
            raise InputError(f'{key}: {name} knows no keys; remove it, and write endpoint = "tcp://127.0.0.1:PORT"')
    if settings.clock == "shared":
        raise InputError(f'clock = "shared": {name} sends the time of its simulation; write clock = "estimated"')


def udp_road(settings: AttitudeSettings) -> tuple[Place, AllowedSenders]:
    """Where UDP is bound, and who may send. Raises InputError, also where an open address has no list of senders."""
    place, allowed = bound_place(settings.bind, settings.port, settings.endpoint), AllowedSenders(settings.allow)
    if not allowed and not place.loopback:
        raise InputError(f"{place} is open to other machines, and allow does not say which may send; {ALLOW_FORM}")
    return place, allowed


def nasa42_road(settings: AttitudeSettings) -> tuple[int, AllowedSenders]:
    """The number of 42's spacecraft, and who may connect. Raises InputError as `udp_road` does."""
    place, allowed = parse_endpoint(settings.address), AllowedSenders(settings.allow)
    if settings.bind is True and not allowed and not place.loopback:
        raise InputError(f"{settings.address} is open to other machines, and allow does not say which may send; {ALLOW_FORM}")
    return spacecraft_number(settings.spacecraft), allowed
