"""What this machine has and what it lacks: GL, displays, links, files."""

from __future__ import annotations

import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from hilstar.attitude.wire.serial_link import serial_ports
from hilstar.attitude.wire.zmq_links import ZmqReceiver, ZmqSender
from hilstar.attitude.wire.zmq_socket import zmq_version
from hilstar.bench.bench_file import BenchFile, read_bench_or_heads
from hilstar.bench.build import bench_calibration, bench_optics
from hilstar.bench.cameras import FieldsOfView, fields_of_view
from hilstar.errors import HilstarError, MachineError
from hilstar.monitor.window.output_settings import OutputState, findings
from hilstar.monitor.window.randr import lit_outputs
from hilstar.monitor.window.window import displays, window_renderer
from hilstar.notices import Notices
from hilstar.render.context import described, gpus, leave_contexts
from hilstar.resources import resource_path
from hilstar.sky.catalog import load_catalog

USUAL_BITS = 8


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that hilstar uses; only `required` ones decide the verdict."""

    name: str
    ok: bool
    detail: str
    required: bool = True


@dataclass(frozen=True, slots=True)
class OutputReport:
    """An output of the X server: its line, what is wrong with it and what mends that, and all that RandR says of it."""

    line: str
    faults: list[str]
    state: dict[str, object]

    @classmethod
    def of(cls, state: OutputState) -> Self:
        """The report of an output that is to show codes of 8 bits."""
        return cls(state.line(), [finding.text for finding in findings(state, USUAL_BITS)], state.fields())


@dataclass(frozen=True, slots=True)
class Examination:
    """The JSON object of `hilstar doctor`: whether everything required is there, the checks, and the displays' outputs."""

    ok: bool
    checks: list[Check]
    outputs: list[OutputReport]


def examine() -> Examination:
    """Check everything that hilstar uses on this machine."""
    checks = [_check(name, look) for name, look in LOOKS.items()]
    checks += [_gpus(), _displays(), _serial()]
    outputs = [OutputReport.of(state) for state in lit_outputs()]
    return Examination(all(check.ok for check in checks if check.required), checks, outputs)


def examine_bench(path: Path) -> dict[str, FieldsOfView]:
    """What the screen and the tracker of a bench file see, or of each of its heads, by the file's name.

    Raises InputError where the file, or one that it names, is wrong.
    """
    file = read_bench_or_heads(path)
    files = (file,) if isinstance(file, BenchFile) else file.files
    for one in files:
        bench_calibration(one.config, one.folder)
        bench_optics(one.config.tracker, one.folder)
    return {one.path.name: fields_of_view(one.config, one.folder) for one in files}


def _check(name: str, look: Callable[[], str]) -> Check:
    try:
        return Check(name, True, look())
    except (HilstarError, OSError) as error:
        return Check(name, False, str(error))


def _python() -> str:
    return f"Python {platform.python_version()}, {sys.executable}"


def _gl() -> str:
    try:
        return described()
    except MachineError as error:
        until_then = "until then NumPy draws frame, simulate and verify, slower; serve, replay and demo need OpenGL"
        raise MachineError(f"{error}; {until_then}") from error


class _Unsaid(Notices):
    """Events of a connection that nobody asked after."""

    def mention(self, kind: str, detail: str) -> None:
        """Say nothing."""


def _zeromq() -> str:
    """One message through a real loopback socket."""
    with ZmqSender("tcp://127.0.0.1:*") as sender, ZmqReceiver(sender.endpoint, notices=_Unsaid()) as receiver:
        receiver.receive(0)  # a receiver connects when it is first read
        if not sender.wait_for_listener(2.0):
            raise MachineError("a loopback connection does not come up; allow TCP on 127.0.0.1")
        begin = time.perf_counter()
        sender.put(b"ping")
        if not receiver.receive(2000):
            raise MachineError("a loopback message does not arrive; allow TCP on 127.0.0.1")
        return f"ZeroMQ {zmq_version()}, loopback message in {(time.perf_counter() - begin) * 1e3:.2f} ms"


def _catalogue() -> str:
    begin = time.perf_counter()
    catalog = load_catalog()
    return f"Hipparcos, {len(catalog)} of {catalog.rows_read} stars, loaded in {(time.perf_counter() - begin) * 1e3:.0f} ms"


def _files() -> str:
    names = [resource_path("shaders", "splat.frag"), resource_path("configs", "demo.toml")]
    return ", ".join(str(path) for path in names)


def _gpus() -> Check:
    """Which GPUs draw headless and in a window."""
    found = gpus()
    leave_contexts()
    try:
        window = window_renderer()
    except MachineError:
        window = ""
    headless = "; ".join(gpu.line() for gpu in found) or "EGL lists none"
    detail = f"headless {headless}; window {window or 'none'}"
    if window and found and window != found[0].renderer:
        detail += " (another than headless: [render] gpu chooses)"
    return Check("gpu", any(gpu.renderer for gpu in found), detail, required=False)


def _displays() -> Check:
    try:
        found = displays()
    except MachineError as error:
        return Check("display", False, str(error), required=False)
    return Check("display", bool(found), "; ".join(display.line() for display in found) or "none", required=False)


def _serial() -> Check:
    ports = serial_ports()
    return Check("serial", bool(ports), ", ".join(ports) or "no serial port", required=False)


LOOKS: dict[str, Callable[[], str]] = {
    "python": _python,
    "opengl": _gl,
    "zeromq": _zeromq,
    "catalogue": _catalogue,
    "files": _files,
}
