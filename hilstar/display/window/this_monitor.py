"""The identity of a display of this machine: by RandR, DRM and, where the program ddcutil is
installed, DDC/CI.
"""

import contextlib
import re
import shutil
import subprocess
from pathlib import Path

import msgspec

from hilstar.basics.errors import MachineError
from hilstar.display.identity import STRAIGHT, MonitorIdentity, edid_identity, sha256_of
from hilstar.display.window.displays import Display
from hilstar.display.window.output_settings import IDENTITY, OutputState
from hilstar.display.window.randr import Randr
from hilstar.display.window.watch import is_straight
from hilstar.display.window.window import displays

DRM = Path("/sys/class/drm")
EDID_BYTES = 128  # the first block
VCP = {"10": "brightness", "12": "contrast", "14": "colour_preset", "C0": "hours"}  # VESA MCCS 2.2a
DDC_S = 10.0  # ddcutil looks at every bus, and asks again where a monitor does not answer


def identity_here(wanted: int | str) -> MonitorIdentity | None:
    """The identity of the display that `[monitor] display` means, before a window is on it; None
    where there is none.
    """
    try:
        display = next(candidate for candidate in displays() if candidate.is_named(wanted))
    except (MachineError, StopIteration):
        return None
    output = None
    ramp = b""
    adds: dict[str, bool] = {}
    with contextlib.suppress(OSError), Randr() as randr:
        ramp = randr.ramp(display.name)
        adds = randr.additions()
        output = next((state for state in randr.outputs() if state.name == display.name), None)
    return identity_of(display, output, ramp, adds)


def identity_of(
    display: Display,
    output: OutputState | None,
    ramp: bytes,
    adds: dict[str, bool],
    drm: Path = DRM,
) -> MonitorIdentity:
    """The identity of a display whose output is so by RandR (None where that does not say), with a
    gamma ramp (b"" for none), and what the window system may add, and whether it does.
    """
    edid = b""
    refresh_hz = float(display.refresh_hz)
    if output is not None:
        edid = output.edid
        refresh_hz = output.refresh_hz
        adds = adds | {"a transform": output.transform != IDENTITY}
    edid = edid or edid_of_drm(display.name, drm)
    width, height = display.resolution_px
    gamma_ramp = sha256_of(ramp)
    if ramp and is_straight(ramp):
        gamma_ramp = STRAIGHT
    return msgspec.structs.replace(
        edid_identity(edid),
        connector=display.name,
        mode=f"{width}x{height}@{refresh_hz:.2f}",
        bits=display.bits,
        gamma_ramp=gamma_ramp,
        window_system=tuple(what for what, there in adds.items() if there),
        **_by_ddc(edid),
    )


def edid_of_drm(connector: str, drm: Path = DRM) -> bytes:
    """The kernel's EDID of a connector, which X may call HDMI-1 where the kernel says HDMI-A-1;
    b"" for none.
    """
    for path in sorted(drm.glob("card*-*/edid")):
        with contextlib.suppress(OSError):
            name = path.parent.name.partition("-")[2]
            if connector not in (name, re.sub(r"-[A-Z](?=-\d)", "", name)):
                continue
            edid = path.read_bytes()
            if edid:
                return edid
    return b""


def _by_ddc(edid: bytes) -> dict[str, int]:
    """The monitor's own settings that it tells by DDC/CI; {} where it does not, or ddcutil is
    not installed.
    """
    program = shutil.which("ddcutil")
    if program is None or len(edid) < EDID_BYTES:
        return {}
    command = [program, "getvcp", *VCP, "--terse", "--edid", edid[:EDID_BYTES].hex()]
    try:
        completed = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=DDC_S, check=False
        ).stdout
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return ddc_settings(completed)


def ddc_settings(printed: str) -> dict[str, int]:
    """The settings that `ddcutil getvcp --terse` prints, by their keys; a line of another form says
    none.
    """
    settings = {}
    # VCP 10 C 40 100 (now, maximum); VCP 14 SNC x05; VCP C0 CNC x00 xff x04 xb0 (maximum, now)
    for code, kind, value_text in re.findall(
        r"^VCP (10|12|14|C0) (C|SNC|CNC) ([\dx a-f]+)$", printed, re.MULTILINE
    ):
        values = value_text.split()
        with contextlib.suppress(ValueError):
            if kind == "C":
                settings[VCP[code]] = int(values[0])
            else:
                low_bytes = "".join(values[-2:])
                settings[VCP[code]] = int(low_bytes.replace("x", ""), 16)
    return settings
