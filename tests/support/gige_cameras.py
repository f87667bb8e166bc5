"""GigE Vision cameras on loopback whose images are a test's own: hilstar's, and Aravis's fake one."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np

from hilstar.attitude.wire.endpoint import AllowedSenders
from hilstar.basics.notices import Notices
from hilstar.server.genicam.camera import SYSTEM_PYTHON
from hilstar.server.gige.camera import GigECamera
from hilstar.server.gige.registers import CameraIdentity, CameraSettings
from tests.support.gige_client import own_address
from tests.support.waiting import PATIENCE_S

FAKE = """
import gi, sys
gi.require_version("Aravis", "0.8")
from gi.repository import Aravis, GLib
camera = Aravis.GvFakeCamera.new(sys.argv[1], "GV02")
print("running" if camera.is_running() else "not running", flush=True)
GLib.MainLoop().run()
"""


def counting(settings: CameraSettings) -> Callable[[int], np.ndarray]:
    """Images (height, width) that are their number everywhere."""
    top = (1 << settings.bits) - 1
    return lambda k: np.full((settings.height_px, settings.width_px), (k + 1) % top, np.uint16)


@contextlib.contextmanager
def running_camera(
    settings: CameraSettings | None = None,
    images: Callable[[int], np.ndarray] | None = None,
    kind: type[GigECamera] = GigECamera,
) -> Iterator[str]:
    """The address of a camera that sends image after image, by default ones that count up."""
    address, stop = own_address(), threading.Event()
    identity = CameraIdentity(ipaddress.IPv4Address(address), "virtual tracker", "1", address[-12:])
    settings = settings or CameraSettings(64, 48, 12, 0.01, 50.0)
    image_of = images or counting(settings)

    def feed() -> None:
        k = 0
        while not stop.wait(1 / settings.rate_hz):
            camera.take(image_of(k), time.monotonic_ns())
            k += 1

    with kind(identity, settings, AllowedSenders(), Notices()) as camera:
        thread = threading.Thread(target=feed)
        thread.start()
        try:
            yield address
        finally:
            stop.set()
            thread.join()


@contextlib.contextmanager
def fake_camera() -> Iterator[str]:
    """The address of Aravis's own fake camera, as arv-fake-gv-camera-0.8 runs it.

    It takes no address but an interface's own: tests of one machine wait for one another.
    """
    address = "127.0.0.1"
    with (
        alone_on_this_machine("fake-camera"),
        subprocess.Popen(
            [SYSTEM_PYTHON, "-c", FAKE, address], stdout=subprocess.PIPE, text=True
        ) as process,
    ):
        try:
            assert process.stdout is not None
            assert process.stdout.readline().strip() == "running"
            yield address
        finally:
            process.kill()
            process.wait(PATIENCE_S)


@contextlib.contextmanager
def alone_on_this_machine(name: str) -> Iterator[None]:
    """Wait until no other process is within this, of whatever user: a file in /tmp is its maker's.

    A name of the kernel's, which goes with the process that has it.
    """
    with socket.socket(socket.AF_UNIX) as lock:
        while True:
            try:
                lock.bind(f"\0hilstar-test-{name}")
                break
            except OSError:
                time.sleep(0.05)
        yield
