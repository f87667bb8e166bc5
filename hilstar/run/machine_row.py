"""This machine as a row of the table *Tested with* (docs/where-it-fails.md): its parts and versions, nothing private.

No host or user name, no path and no serial number: of a monitor's EDID only its maker, model, size and year are read.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from hilstar.attitude.wire.serial_link import adapters
from hilstar.attitude.wire.zmq_socket import zmq_version
from hilstar.errors import HilstarError, MachineError
from hilstar.monitor.window.window import displays
from hilstar.monitor.window.x11 import server_of
from hilstar.render.context import create_context
from hilstar.version import __version__

COLUMNS = ("hilstar", "machine", "OpenGL", "display server", "monitors", "links", "what was measured, and what came out")
TO_FILL = "(write it here)"
NOT_THERE = "none"
SYS, PROC = Path("/sys"), Path("/proc")
EDID_HEADER = bytes.fromhex("00ffffffffffff00")
EDID_BYTES, DESCRIPTORS, DESCRIPTOR_BYTES, NAME_TAG = 128, (54, 72, 90, 108), 18, 0xFC


@dataclass(frozen=True, slots=True)
class Edid:
    """What a monitor says of itself (VESA E-EDID 1.4, section 3): three letters of its maker, its model, year and size."""

    maker: str
    product: int
    name: str
    year: int
    size_cm: tuple[int, int]

    def line(self) -> str:
        """The monitor for a person."""
        width_cm, height_cm = self.size_cm
        return f"{self.maker} {self.name or f'{self.product:04x}'} ({self.year}, {width_cm} x {height_cm} cm)"


def read_edid(data: bytes) -> Edid | None:
    """An EDID's first block read; None where it is none. Its serial number (bytes 12 to 15, and a text) is left out."""
    if len(data) < EDID_BYTES or data[:8] != EDID_HEADER or sum(data[:EDID_BYTES]) % 256:
        return None
    code = int.from_bytes(data[8:10], "big")
    maker = "".join(chr(64 + (code >> shift & 31)) for shift in (10, 5, 0))
    texts = [data[at + 5 : at + DESCRIPTOR_BYTES] for at in DESCRIPTORS if data[at : at + 5] == bytes((0, 0, 0, NAME_TAG, 0))]
    name = texts[0].split(b"\n")[0].decode("cp437").strip() if texts else ""
    return Edid(maker, int.from_bytes(data[10:12], "little"), name, 1990 + data[17], (data[21], data[22]))


def row() -> dict[str, str]:
    """This machine's cells by their columns; the last is for who measured."""
    cells = (_hilstar(), _machine(), _opengl(), _display_server(), _monitors(), _links(), TO_FILL)
    return dict(zip(COLUMNS, map(_cell, cells), strict=True))


def table(cells: dict[str, str]) -> str:
    """The table with this row, in Markdown."""
    rows = (tuple(cells), ("---",) * len(cells), tuple(cells.values()))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "/")


def _hilstar() -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("moderngl", "glfw"))
    return f"{__version__}; Python {platform.python_version()}, ZeroMQ {zmq_version()}, {packages}"


def _machine() -> str:
    model = _text(SYS / "firmware/devicetree/base/model") or _cpu()  # a Raspberry Pi or a Jetson
    with contextlib.suppress(OSError):
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
        return f"{model}, {os.cpu_count()} cores, {platform.machine()}; {system}, Linux {_version(platform.release())}"
    return f"{model}, {os.cpu_count()} cores, {platform.machine()}; {platform.system()} {_version(platform.release())}"


def _version(release: str) -> str:
    """The numbers of a kernel's release: what follows them may have been chosen by somebody, and name somebody."""
    found = re.match(r"\d+(\.\d+)*", release)
    return found[0] if found else ""


def _cpu() -> str:
    found = re.search(r"^(?:model name|Hardware)\s*:\s*(.+)$", _text(PROC / "cpuinfo"), re.MULTILINE)
    return found[1] if found else "processor not named"


def _opengl() -> str:
    try:
        context = create_context()
    except (HilstarError, OSError) as error:
        return f"{NOT_THERE}: {error}"
    try:
        found = f"{context.info['GL_RENDERER']}, OpenGL {context.info['GL_VERSION']}"
    finally:
        context.release()
    drivers = ", ".join(dict.fromkeys(_gpus()))
    return f"{found}; kernel driver {drivers}" if drivers else found


def _gpus() -> Iterator[str]:
    """Kernel driver and PCI identity of each graphics card."""
    for card in sorted((SYS / "class/drm").glob("card[0-9]")):
        with contextlib.suppress(OSError):
            driver = (card / "device/driver").resolve(strict=True).name
            identity = ":".join(_text(card / "device" / part).removeprefix("0x") for part in ("vendor", "device"))
            yield f"{driver} ({identity})" if identity.strip(":") else driver


def _display_server() -> str:
    session = os.environ.get("XDG_SESSION_TYPE", "")
    found = _told(server_of)
    wayland = "a Wayland session" if os.environ.get("WAYLAND_DISPLAY") or session == "wayland" else ""
    return ", ".join(part for part in (found, wayland) if part) or NOT_THERE


def _monitors() -> str:
    with contextlib.suppress(MachineError):
        shown = [re.sub(r"^\d+: ", "", display.line()) for display in displays()]
        return "; ".join([*shown, *(f"EDID {edid.line()}" for edid in _edids())]) or NOT_THERE
    return "; ".join(f"EDID {edid.line()}" for edid in _edids()) or NOT_THERE


def _edids() -> Iterator[Edid]:
    for path in sorted((SYS / "class/drm").glob("card*-*/edid")):
        with contextlib.suppress(OSError):
            if (edid := read_edid(path.read_bytes())) is not None:
                yield edid


def _links() -> str:
    return "; ".join(["ZeroMQ and UDP over loopback", *(f"serial {words}" for words in adapters())])


def _told(ask: Callable[[], str]) -> str:
    try:
        return ask()
    except OSError:
        return ""


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    return ""
