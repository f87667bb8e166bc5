"""[sync], and what its keys mean together with those of other tables."""

from __future__ import annotations

import re
from typing import Annotated, Literal

from msgspec import Meta

from hilstar.bench.config.monitor import Monitor
from hilstar.bench.config.stream.attitude import AttitudeSettings
from hilstar.bench.config.tracker import Tracker
from hilstar.bench.config.values import Positive
from hilstar.errors import InputError
from hilstar.toml_tables import Table

NETWORK_PORT = "rfc2217://"
ROUNDING = 1e-6  # relative: 0.1 s at 10 Hz is one exposure after the other


class SyncSettings(Table, frozen=True):
    """The tracker's exposures and the monitor's refresh: how they beat, and a pulse for a tracker that takes a trigger.

    An exposure of whole refreshes sees whole frames; of one that is not, the parts at both ends are counted where their frames'
    middles are, and a star of a turning camera is off by an amount that depends on the phase between the two. A panel that
    flashes (`[monitor] hold_ms`) is seen at its flashes alone, and whole refreshes cure its light, not its places.
    `serve`, when it starts, and `first-light` say how much that is where it is over `[render] tolerance_px` or `tolerance_mag`,
    and the nearest refresh rate and exposure without it.

    With `port`, `serve` and `replay` raise the line RTS of a serial port at each frame: on a screen after its swap, headless at
    the frame's moment. The host's scheduling and a USB adapter's own time are in the pulse's delay; `--json` has its mean and
    standard deviation against the frames' time stamps as far as this machine sees them. A line that is lost is tried again and
    never stops the display. Write `[tracker] trigger = "external"` for a tracker that exposes by it.
    """

    port: Annotated[
        str | None,
        Meta(
            description='The serial port whose RTS is pulsed, such as `"/dev/ttyUSB0"`, or `"rfc2217://HOST:PORT"`. Not the '
            "attitude's.",
            extra={"default": "none"},
        ),
    ] = None
    pulse_ms: Annotated[Positive, Meta(description="Width of the pulse, at least.")] = 1.0
    active: Annotated[
        Literal["high", "low"],
        Meta(
            description='`"high"`: RTS is set (positive on RS-232) in the pulse and cleared between. `"low"`: the other way '
            "round. Adapters with TTL levels have their lines inverted: set is 0 V."
        ),
    ] = "high"
    every_frames: Annotated[int, Meta(ge=1, le=1_000_000, description="A pulse at every so many frames.")] = 1
    turn_deg_s: Annotated[
        Positive, Meta(description="Rate of turn at which `serve` and `first-light` judge what a beat costs.")
    ] = 1.0


def check_sync(sync: SyncSettings, tracker: Tracker, monitor: Monitor, attitude: AttitudeSettings) -> None:
    """Refuse (InputError) exposures that overlap, a pulse that lasts until the next, and a port that is the attitude's."""
    if tracker.frame_hz is not None and tracker.frame_hz * tracker.exposure_s > 1 + ROUNDING:
        most = f"{1 / tracker.exposure_s:.6g} or less"
        raise InputError(
            f"[tracker] frame_hz = {tracker.frame_hz:g}: exposures of {tracker.exposure_s:g} s overlap; write {most}"
        )
    if sync.port is None:
        return
    if not (sync.port.strip() and sync.port.isprintable()) or (
        "://" in sync.port and not re.fullmatch(NETWORK_PORT + r"[^/?]+:\d{1,5}([/?].*)?", sync.port)
    ):
        advice = f'write "/dev/ttyUSB0" or the like, or "{NETWORK_PORT}HOST:PORT"; leave it out for no pulse'
        raise InputError(f"[sync] port = {sync.port!r}: {advice}")
    between_ms = sync.every_frames * monitor.period_ms
    if sync.pulse_ms >= between_ms:
        what = f"[sync] pulse_ms = {sync.pulse_ms:g}: the next pulse is due after {between_ms:.4g} ms"
        raise InputError(f"{what}; write a shorter pulse, or a larger every_frames")
    if attitude.source == "serial" and sync.port == attitude.port:
        raise InputError(f"[sync] port = {sync.port}: the attitude comes over it; write another port")
