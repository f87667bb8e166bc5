"""What this machine has and what it lacks: GL, displays, links, files.

Its row in the table *Tested with* (docs/where-it-fails.md) has parts and versions, nothing private:
no host or user name, no path and no serial number. Of a monitor's EDID only its maker, model, size
and year are read.
"""

import contextlib
import datetime
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hilstar.attitude.wire.serial_link import adapters, serial_ports
from hilstar.attitude.wire.zmq_links import ZmqReceiver, ZmqSender
from hilstar.attitude.wire.zmq_socket import zmq_version
from hilstar.basics.errors import HilstarError, MachineError
from hilstar.basics.notices import Notices
from hilstar.basics.resources import resource_path
from hilstar.basics.version import __version__
from hilstar.display.identity import TABLE, edid_identity
from hilstar.display.render.context import create_context, described, gpus
from hilstar.display.window.output_settings import findings
from hilstar.display.window.randr import lit_outputs
from hilstar.display.window.this_monitor import identity_here
from hilstar.display.window.window import displays, window_renderer
from hilstar.display.window.x11 import server_of
from hilstar.server.bench.bench_file import BenchFile, read_bench_or_heads
from hilstar.server.bench.cameras import FieldsOfView, bench_camera, fields_of_view
from hilstar.server.bench.measured_on import MonitorCheck, check_monitor
from hilstar.server.bench.monitor import bench_calibration
from hilstar.server.bench.star_rates import bench_optics
from hilstar.server.bench.star_size import StarSize, star_size
from hilstar.server.genicam.camera import INSTALL, child_command, list_cameras
from hilstar.sky.catalog import load_catalog

USUAL_BITS = 8
COLUMNS = (
    "hilstar",
    "machine",
    "OpenGL",
    "display server",
    "monitors",
    "links",
    "what was measured, and what came out",
)
TO_FILL = "(write it here)"
NOT_THERE = "none"
SYS, PROC = Path("/sys"), Path("/proc")


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that hilstar uses; only `required` ones decide the verdict."""

    name: str
    ok: bool
    detail: str
    required: bool = True

    def line(self) -> str:
        """For a person."""
        absence = "MISSING" if self.required else "none"
        state = "ok" if self.ok else absence
        return f"{state:8}{self.name:12}{self.detail}"


@dataclass(frozen=True, slots=True)
class OutputReport:
    """An output of the X server: its line, what is wrong with it and what mends that, and all
    that RandR says of it.
    """

    line: str
    faults: list[str]
    state: dict[str, object]

    def lines(self) -> list[str]:
        """For a person."""
        return [
            f"{'check' if self.faults else 'ok':8}{'output':12}{self.line}",
            *(f"{'':20}{fault}" for fault in self.faults),
        ]


@dataclass(frozen=True, slots=True)
class Examination:
    """The JSON object of `hilstar doctor`: whether everything required is there, the checks, and
    the displays' outputs.
    """

    ok: bool
    checks: list[Check]
    outputs: list[OutputReport]


def examine() -> Examination:
    """Check everything that hilstar uses on this machine."""
    checks = [_check(name, look) for name, look in LOOKS.items()]
    shown = _check(
        "display", lambda: "; ".join(display.line() for display in displays()) or NOT_THERE
    )
    ports = serial_ports()
    checks += [
        _gpus(),
        replace(shown, ok=shown.ok and shown.detail != NOT_THERE, required=False),
        Check("serial", bool(ports), ", ".join(ports) or "no serial port", required=False),
        _cameras(),
    ]
    outputs = []
    for state in lit_outputs():
        outputs.append(
            OutputReport(
                state.line(),
                [finding.text for finding in findings(state, USUAL_BITS)],
                state.fields(),
            )
        )
    return Examination(all(check.ok for check in checks if check.required), checks, outputs)


def _cameras() -> Check:
    """The cameras that `--grab genicam:` can open."""
    if child_command() is None:
        return Check("cameras", ok=False, detail=f"not looked for: {INSTALL}", required=False)
    lines = [
        "{vendor}-{model}, serial {serial}, at {address} ({protocol})".format(**camera)
        for camera in list_cameras()
    ]
    return Check("cameras", bool(lines), "; ".join(lines) or "no camera", required=False)


@dataclass(frozen=True, slots=True)
class BenchReport:
    """What a bench's screen and tracker see, how wide a star is then, and its monitor against
    its files.
    """

    fields: FieldsOfView
    star: StarSize
    monitor: MonitorCheck

    def keys(self) -> dict[str, Any]:
        """By the keys of `doctor --json`."""
        now = self.monitor.now
        monitor_notes = {"fault": self.monitor.fault, "notice": self.monitor.notice}
        return {
            **self.fields.keys(),
            "star": self.star.keys(),
            **({} if now is None else {"monitor": {TABLE: now.known(), **monitor_notes}}),
        }

    def lines(self, name: str) -> Iterator[str]:
        """For a person, by the bench file's name."""
        state = "ok" if self.fields.warning is None else "check"
        # a name of any length stands apart from the text
        yield f"{state:8}{name + ' ':12}{self.fields.line()}"
        yield f"{'check' if self.star.too_wide else 'ok':8}{'star':12}{self.star.line()}"
        fault = self.star.fault()
        remedy = self.star.would_do
        if fault is not None and remedy is not None:
            yield from (f"{'':20}{line}" for line in (fault, *remedy.lines()))
        if self.monitor.now is not None:
            state = "CHANGED" if self.monitor.fault else "ok"
            yield f"{state:8}{'monitor':12}{self.monitor.now.name()}"
            yield from [f"{'':20}{self.monitor.notice}"] * bool(self.monitor.notice)


def examine_bench(path: Path | None, today: datetime.date) -> dict[str, BenchReport]:
    """The report on a bench file, or on each of its heads, by the file's name; none on no file.

    Raises InputError where the file, or one that it names, is wrong.
    """
    if path is None:
        return {}
    file = read_bench_or_heads(path)
    files = (file,) if isinstance(file, BenchFile) else file.files
    for one in files:
        bench_calibration(one.config, one.folder)
        bench_optics(one.config.tracker, one.folder)
    return {one.path.name: _report_on(one, today) for one in files}


def _report_on(file: BenchFile, today: datetime.date) -> BenchReport:
    now = identity_here(file.config.monitor.display)
    if now is None:
        check = MonitorCheck(None)
    else:
        check = check_monitor(file, now, today)
    config = file.config
    folder = file.folder
    return BenchReport(
        fields_of_view(config, folder),
        star_size(config, folder, bench_camera(config, folder)),
        check,
    )


def _check(name: str, look: Callable[[], str]) -> Check:
    try:
        return Check(name, True, look())
    except (HilstarError, OSError) as error:
        return Check(name, False, str(error))


def _gl() -> str:
    try:
        return described()
    except MachineError as error:
        until_then = (
            "until then the processor draws frame, simulate and verify; serve, replay and demo need"
            " OpenGL"
        )
        raise MachineError(f"{error}; {until_then}") from error


class _Unsaid(Notices):
    def mention(self, kind: str, detail: str) -> None:
        """Say nothing."""


def _zeromq() -> str:
    """One message through a real loopback socket."""
    with (
        ZmqSender("tcp://127.0.0.1:*") as sender,
        ZmqReceiver(sender.endpoint, notices=_Unsaid()) as receiver,
    ):
        receiver.receive(0)  # a receiver connects when it is first read
        if not sender.wait_for_listener(2.0):
            raise MachineError("a loopback connection does not come up; allow TCP on 127.0.0.1")
        begin = time.perf_counter()
        sender.put(b"ping")
        if not receiver.receive(2000):
            raise MachineError("a loopback message does not arrive; allow TCP on 127.0.0.1")
        return (
            f"ZeroMQ {zmq_version()}, loopback message in"
            f" {(time.perf_counter() - begin) * 1e3:.2f} ms"
        )


def _catalogue() -> str:
    begin = time.perf_counter()
    catalog = load_catalog()
    return (
        f"Hipparcos, {len(catalog)} of {catalog.rows_read} stars, loaded in"
        f" {(time.perf_counter() - begin) * 1e3:.0f} ms"
    )


def _gpus() -> Check:
    listed = gpus()
    try:
        window = window_renderer()
    except MachineError:
        window = ""
    headless = "; ".join(gpu.line() for gpu in listed) or "EGL lists none"
    detail = f"headless {headless}; window {window or 'none'}"
    if window and listed and window != listed[0].renderer:
        detail += " (another than headless: [render] gpu chooses)"
    return Check("gpu", any(gpu.renderer for gpu in listed), detail, required=False)


LOOKS: dict[str, Callable[[], str]] = {
    "python": lambda: f"Python {platform.python_version()}, {sys.executable}",
    "opengl": _gl,
    "zeromq": _zeromq,
    "catalogue": _catalogue,
    "files": lambda: (
        f"{resource_path('shaders', 'splat.frag')}, {resource_path('configs', 'demo.toml')}"
    ),
}


def row() -> dict[str, str]:
    """This machine's cells by their columns; the last is for who measured."""
    packages = ", ".join(f"{name} {version(name)}" for name in ("moderngl", "glfw"))
    versions_text = (
        f"{__version__}; Python {platform.python_version()}, ZeroMQ {zmq_version()}, {packages}"
    )
    links = "; ".join(
        ["ZeroMQ and UDP over loopback", *(f"serial {adapter_text}" for adapter_text in adapters())]
    )
    cells = (versions_text, _machine(), _opengl(), _display_server(), _monitors(), links, TO_FILL)
    return {
        name: " ".join(text.split()).replace("|", "/")
        for name, text in zip(COLUMNS, cells, strict=True)
    }


def table(cells: dict[str, str]) -> str:
    """The table with this row, in Markdown."""
    rows = (tuple(cells), ("---",) * len(cells), tuple(cells.values()))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _machine() -> str:
    model = _text(SYS / "firmware/devicetree/base/model")  # a Raspberry Pi or a Jetson
    if not model:
        cpu = re.search(
            r"^(?:model name|Hardware)\s*:\s*(.+)$", _text(PROC / "cpuinfo"), re.MULTILINE
        )
        model = cpu[1] if cpu else "processor not named"
    system = platform.system()
    with contextlib.suppress(OSError):
        system = f"{platform.freedesktop_os_release()['PRETTY_NAME']}, Linux"
    # The numbers of the kernel's release alone: what follows them may name somebody.
    release = re.match(r"(?:\d+(?:\.\d+)*)?", platform.release())
    return (
        f"{model}, {os.cpu_count()} cores, {platform.machine()}; {system}"
        f" {release[0] if release else ''}"
    )


def _opengl() -> str:
    try:
        context = create_context()
    except (HilstarError, OSError) as error:
        return f"{NOT_THERE}: {error}"
    try:
        driver_text = f"{context.info['GL_RENDERER']}, OpenGL {context.info['GL_VERSION']}"
    finally:
        context.release()
    drivers = ", ".join(dict.fromkeys(_cards()))
    if drivers:
        return f"{driver_text}; kernel driver {drivers}"
    return driver_text


def _cards() -> Iterator[str]:
    for card in sorted((SYS / "class/drm").glob("card[0-9]")):
        with contextlib.suppress(OSError):
            driver = (card / "device/driver").resolve(strict=True).name
            identity = ":".join(
                _text(card / "device" / part).removeprefix("0x") for part in ("vendor", "device")
            )
            yield f"{driver} ({identity})" if identity.strip(":") else driver


def _display_server() -> str:
    session = os.environ.get("XDG_SESSION_TYPE", "")
    server_text = ""
    with contextlib.suppress(OSError):
        server_text = server_of()
    if os.environ.get("WAYLAND_DISPLAY") or session == "wayland":
        wayland = "a Wayland session"
    else:
        wayland = ""
    return ", ".join(part for part in (server_text, wayland) if part) or NOT_THERE


def _monitors() -> str:
    shown: list[str] = []
    with contextlib.suppress(MachineError):
        shown += [re.sub(r"^\d+: ", "", display.line()) for display in displays()]
    for path in sorted((SYS / "class/drm").glob("card*-*/edid")):
        with contextlib.suppress(OSError):
            if (found := edid_identity(edid := path.read_bytes())).maker:
                shown.append(
                    f"EDID {found.maker} {found.model} ({found.year}, {edid[21]} x {edid[22]} cm)"
                )
    return "; ".join(shown) or NOT_THERE


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text(encoding="utf-8", errors="replace").strip("\0\n ")
    return ""
