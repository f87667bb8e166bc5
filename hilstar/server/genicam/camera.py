"""A GenICam camera of this machine, opened in a child: by Aravis in the system's Python, or by
Harvesters and a vendor's GenTL producer in this one.
"""

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import InputError, MachineError, shortened
from hilstar.basics.process.closing import Closing
from hilstar.basics.units import NS_PER_US
from hilstar.server.genicam.pixels import FORMAT, mosaic_of, unpacked

PREFIX = "genicam:"
# A virtual environment cannot import Debian's `gi`: the system's own Python can.
SYSTEM_PYTHON = Path("/usr/bin/python3")
CHILD = Path(__file__).with_name("aravis_child.py")
HARVESTERS_CHILD = Path(__file__).with_name("harvesters_child.py")
PROBE = "import gi; gi.require_version('Aravis', '0.8'); from gi.repository import Aravis"
PRODUCERS = "GENICAM_GENTL64_PATH"
INSTALL = (
    "install Aravis: sudo apt-get install gir1.2-aravis-0.8 python3-gi; or the vendor's GenTL"
    f' producer, whose directory is in {PRODUCERS}, and pip install "hilstar[genicam]"'
)
LIST_TIMEOUT_S = 15.0
OPEN_TIMEOUT_S = 30.0
GRAB_TIMEOUT_S = 60.0
CLOSE_TIMEOUT_S = 2.0
# Of an exposure as it was asked for: a camera sets it in steps of a row or a microsecond.
EXPOSURE_TOLERANCE, EXPOSURE_STEP_US = 0.01, 20.0


def has_aravis() -> bool:
    """Whether the system's Python has Aravis."""
    if not SYSTEM_PYTHON.exists():
        return False
    probe = subprocess.run([SYSTEM_PYTHON, "-c", PROBE], capture_output=True, check=False)
    return probe.returncode == 0


def has_harvesters() -> bool:
    """Whether Harvesters is installed and there is a GenTL producer for it."""
    folders = os.environ.get(PRODUCERS, "").split(os.pathsep)
    has_producer = any(folder and any(Path(folder).glob("*.cti")) for folder in folders)
    return has_producer and find_spec("harvesters") is not None


def child_command() -> list[str] | None:
    """What runs a child that opens cameras; None where nothing here can.

    A producer is there on purpose, and goes before Aravis.
    """
    if has_harvesters():
        return [sys.executable, str(HARVESTERS_CHILD)]
    if has_aravis():
        return [str(SYSTEM_PYTHON), str(CHILD)]
    return None


def list_cameras() -> list[dict[str, str]]:
    """The cameras of this machine: `id`, `vendor`, `model`, `serial`, `address` and `protocol`;
    none where nothing here can open one.
    """
    command = child_command()
    if command is None:
        return []
    try:
        listed = subprocess.run(
            [*command, "list"],
            capture_output=True,
            text=True,
            timeout=LIST_TIMEOUT_S,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return []
    if listed.returncode:
        return []
    cameras: list[dict[str, str]] = json.loads(listed.stdout)
    return cameras


@dataclass(frozen=True, slots=True)
class CameraImage:
    """An image (height, width) in DN, and what its camera says of it.

    `begun_utc_ns` is when the exposure began by the host's clock: its first bytes came an exposure
    later. `bayer` is the mosaic's pattern such as "RGGB", "" without one. `incomplete` images came
    before it.
    """

    dn: npt.NDArray[np.uint16]
    exposure_s: float
    begun_utc_ns: int
    bayer: str
    incomplete: int


@dataclass(frozen=True, slots=True)
class Film:
    """Images of a camera that exposes again and again: DN (n, rows, columns) in their order.

    `stamp_ns` (n,) are their times by the camera's clock, and `arrived_utc_ns` (n,) when their
    first bytes came. `incomplete` ones are not among them.
    """

    dn: npt.NDArray[np.unsignedinteger]
    stamp_ns: npt.NDArray[np.int64]
    arrived_utc_ns: npt.NDArray[np.int64]
    exposure_s: float
    incomplete: int


class CameraError(MachineError):
    """What a camera answers to a request that it refuses."""


class GenicamCamera(Closing):
    """A camera, opened and set. Free it with `close`.

    `name` is a serial number, VENDOR-MODEL or an address, "" the only camera. Raises MachineError
    where nothing here can open one, or the camera is not there.
    """

    def __init__(self, name: str) -> None:
        child = child_command()
        if child is None:
            raise MachineError(f"--grab {PREFIX}{name}: {INSTALL}")
        self.name = name
        self._folder = tempfile.TemporaryDirectory(prefix="hilstar-camera-")
        self._file = Path(self._folder.name) / "image"
        self._asked: tuple[float, float] | None = None  # an exposure, us, and until when, s
        self._child = subprocess.Popen(
            [*child, "grab", name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._line = bytearray()
        try:
            self.about = self._awaited()
        except MachineError:
            self.close()
            raise

    def set(self, features: Mapping[str, Any]) -> None:
        """Set features by their names. Raises InputError for one that the camera does not take."""
        self._ask({"set": dict(features)})
        try:
            self._awaited()
        except CameraError as error:
            raise InputError(f"[tracker.camera]: {error}") from error

    def _awaited(self, seconds: float = OPEN_TIMEOUT_S) -> dict[str, Any]:
        end_s = time.monotonic() + seconds
        while (answer := self._answer()) is None:
            self._check_time(end_s, "does not answer")
            time.sleep(0.01)
        return answer

    def _ask(self, request: Mapping[str, Any]) -> None:
        assert self._child.stdin is not None
        try:
            self._child.stdin.write(json.dumps(request).encode() + b"\n")
            self._child.stdin.flush()
        except OSError as error:
            raise MachineError(self._said("is gone")) from error

    def begin(self, exposure_s: float) -> None:
        """Ask for an image that is exposed from now on."""
        exposure_us = exposure_s * 1e6
        self._ask({"exposure_us": exposure_us, "file": str(self._file)})
        self._asked = exposure_us, time.monotonic() + GRAB_TIMEOUT_S + 8 * exposure_s

    def image(self) -> CameraImage | None:
        """The image that was asked for; None while it has not come.

        Raises MachineError where none comes, InputError for one that cannot be read or whose
        exposure is not what was asked for.
        """
        assert self._asked is not None
        exposure_us, end_s = self._asked
        answer = self._answer()
        if answer is None:
            self._check_time(end_s, "gave no image")
            return None
        self._asked = None
        self._check_exposure(exposure_us, answer["exposure_us"])
        data = self._file.read_bytes()
        return CameraImage(
            dn=unpacked(data, answer["format"], answer["width"], answer["height"]),
            exposure_s=answer["exposure_us"] / 1e6,
            begun_utc_ns=answer["arrived_utc_ns"] - round(answer["exposure_us"] * NS_PER_US),
            bayer=mosaic_of(answer["format"]),
            incomplete=answer["incomplete"],
        )

    def grab(self, exposure_s: float) -> CameraImage:
        """One image. Raises MachineError, InputError."""
        self.begin(exposure_s)
        while (image := self.image()) is None:
            time.sleep(0.002)
        return image

    def film(self, exposure_s: float, seconds: float, rows: tuple[int, int] | None = None) -> Film:
        """Images of `seconds`; of each the rows from the first to before the last, or all.

        The pixel format is one of whole bytes a pixel. They lie in a file until the next image.
        Raises MachineError, InputError.
        """
        exposure_us = exposure_s * 1e6
        self._ask(
            {"exposure_us": exposure_us, "file": str(self._file), "film": seconds, "rows": rows}
        )
        answer = self._awaited(seconds + GRAB_TIMEOUT_S)
        self._check_exposure(exposure_us, answer["exposure_us"])
        match = FORMAT.fullmatch(answer["format"])
        if match is None or match[3]:
            raise InputError(
                self._said(
                    f"films in {answer['format']}; write [tracker.camera] pixel_format of whole"
                    ' bytes, such as "Mono8"'
                )
            )
        count = len(answer["frames"])
        if not count:
            raise MachineError(self._said("gave no whole image; look at its link"))
        first, last = rows or (0, answer["height"])
        kind = np.dtype(np.uint8 if match[2] == "8" else "<u2")
        shape = count, last - first, answer["width"]
        stamp_ns, arrived_ns = np.array(answer["frames"], dtype=np.int64).T
        return Film(
            np.memmap(self._file, dtype=kind, mode="r", shape=shape),
            stamp_ns,
            arrived_ns,
            answer["exposure_us"] / 1e6,
            answer["incomplete"],
        )

    def _check_exposure(self, asked_us: float, exposure_us: float) -> None:
        off_us = abs(exposure_us - asked_us)
        if off_us > max(EXPOSURE_TOLERANCE * asked_us, EXPOSURE_STEP_US):
            low_us, high_us = self.about["exposure_us"]
            raise InputError(
                self._said(
                    f"exposes for {exposure_us / 1e6:.6g} s where {asked_us / 1e6:.6g} s were asked"
                    f" for; it can do {low_us / 1e6:.3g} to {high_us / 1e6:.3g} s"
                )
            )

    def _answer(self) -> dict[str, Any] | None:
        """The child's next line; None while it has none. Raises MachineError."""
        stdout = self._child.stdout
        assert stdout is not None
        while select.select([stdout], [], [], 0)[0]:
            data = os.read(stdout.fileno(), 1 << 16)
            if not data:
                raise MachineError(self._said(f"is gone: {self._last_words()}"))
            self._line += data
            if b"\n" in self._line:
                line, _, rest = self._line.partition(b"\n")
                self._line = rest
                answer: dict[str, Any] = json.loads(line)
                if "error" in answer:
                    raise CameraError(self._said(answer["error"]))
                return answer
        return None

    def _last_words(self) -> str:
        self._child.kill()
        _, err = self._child.communicate()
        lines = err.decode(errors="replace").strip().splitlines()
        if lines:
            return shortened(lines[-1])
        return "it ended without a word"

    def _check_time(self, end_s: float, what: str) -> None:
        if time.monotonic() > end_s:
            raise MachineError(self._said(f"{what}; look at its link and its trigger"))

    def _said(self, what: str) -> str:
        return f"--grab {PREFIX}{self.name}: {what}"

    def close(self) -> None:
        """Let the camera go, for the next who opens it."""
        # With its input at an end the child lets it go; in the middle of an exposure it cannot.
        try:
            self._child.communicate(timeout=CLOSE_TIMEOUT_S)
        except (subprocess.TimeoutExpired, ValueError):  # it is late, or has been closed
            self._child.kill()
            self._child.wait()
        self._folder.cleanup()


def chosen_format(formats: list[str], bits: int) -> str:
    """The pixel format of a detector of `bits` among a camera's: as many bits without packing,
    else packed, else the fewest above, else the most.
    """
    known = [name for name in formats if FORMAT.fullmatch(name)]
    if not known:
        raise InputError(
            f"the camera has no format of grey or Bayer: it has {', '.join(formats) or 'none'}"
        )

    def order(name: str) -> tuple[bool, int, str]:
        match = FORMAT.fullmatch(name)
        assert match is not None
        more = int(match[2]) - bits
        return more < 0, abs(more), match[3] or ""

    return min(known, key=order)
