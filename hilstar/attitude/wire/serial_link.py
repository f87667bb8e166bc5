"""Serial ports: a road of bytes by a device that may be unplugged and come back, the link of COBS
frames on it, lines of text, and the output line RTS.
"""

import contextlib
import errno
import os
import re
import select
import termios
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import serial
from serial.tools import list_ports

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.apart import ReaderProcess
from hilstar.attitude.wire.likeness import MAX_LOOKED_AT, unframed_packet
from hilstar.attitude.wire.links import Decoder, StreamLink, pieces
from hilstar.attitude.wire.road_use import RoadUse
from hilstar.attitude.wire.roads import ATTITUDES, ByteRoad, RawMessage, is_readable, read_device
from hilstar.attitude.wire.source import AS_SENT, SentAttitudes
from hilstar.basics.errors import HilstarError, InputError, NotThereError, one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_S

DEFAULT_BAUD = 115_200
MAX_DRAIN_S, DRAIN_LOOK_S = 0.5, 0.005
BITS_PER_BYTE = 10  # 8N1: a start bit, 8 bits, a stop bit
FRAMING_BYTES = 2  # the byte that COBS adds, and the 0x00 at the end
READ_S = 0.05
MAX_LINE_BYTES = 256
# what pyserial says where no server answers for a port on the network
NO_SERVER = re.compile("refused|timed out|unreachable|No route", re.IGNORECASE)
NOT_THERE = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
# What pyserial raises for a port that has gone: OSError from the system, the others from its own
# ports over a network.
LOST = (OSError, TypeError, ValueError)


def serial_target(text: str) -> tuple[str, int] | None:
    """The port and the baud rate of "serial:/dev/ttyX@BAUD" (without @BAUD, DEFAULT_BAUD); None
    for a target that is not serial. Raises InputError for one that is written wrong.
    """
    if not text.startswith("serial:"):
        return None
    match = re.fullmatch(r"serial:(.+?)(?:@(\d{1,8}))?", text)
    if match is None or not match[1] or "@" in match[1] or (match[2] and not int(match[2])):
        raise InputError(f"{text}: write serial:/dev/ttyX@BAUD, such as serial:/dev/ttyUSB0@921600")
    return match[1], int(match[2] or DEFAULT_BAUD)


def serial_ports() -> list[str]:
    """The serial ports of this machine as text, each with its description in brackets."""
    return [f"{port.device} ({port.description})" for port in sorted(list_ports.comports())]


def adapters() -> list[str]:
    """The kinds of this machine's serial ports, with their USB ids and without names and serial
    numbers, such as "FT232R USB UART (0403:6001)"; "2 x " precedes a kind that is there twice.
    """
    ports = sorted(list_ports.comports())
    kinds: Counter[str] = Counter()
    for port in ports:
        kind = "UART"
        if port.vid is not None:
            kind = f"{port.product or 'USB'} ({port.vid:04x}:{port.pid:04x})"
        kinds[kind] += 1
    return [f"{count} x {kind}" if count > 1 else kind for kind, count in kinds.items()]


def open_port(port: str, baud: int) -> serial.Serial:
    """A port, opened for this process alone, whose reads do not wait. Raises OSError, ValueError or
    OverflowError where it cannot be opened at this baud rate.
    """
    device = serial.Serial(port, baud, timeout=0, exclusive=True)
    # A USB adapter otherwise buffers for 16 ms. A pty has no such mode.
    with contextlib.suppress(OSError, ValueError):
        device.set_low_latency_mode(True)
    return device


class SerialRoad(ByteRoad):
    """A serial port that is reopened, with back-off, whenever it disappears.

    Raises InputError where the port cannot be opened at the start, MachineError where it is not
    there.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        use: RoadUse = ATTITUDES,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        super().__init__(f"serial:{port}@{baud}", use, notices, clock)
        self._port = port
        self._baud = baud
        self._device: serial.Serial | None = None
        try:
            self._open()
        except (OSError, ValueError, OverflowError) as error:  # SerialException is an OSError
            raise opening_refusal(f"{use.where}{self.endpoint}", error, port) from error

    def _open(self) -> None:
        self._device = open_port(self._port, self._baud)
        self._opened()

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """See `ByteRoad.taken`."""
        device = self._device
        if device is None:
            self._try_again(self._open, LOST, timeout_ms)
            return []
        try:
            return self._read(device, timeout_ms)
        except LOST as error:
            self._lose(_reason(error))
            return []

    def _read(self, device: serial.Serial, timeout_ms: int) -> list[RawMessage]:
        return read_device(device.fileno(), timeout_ms, self._clock)

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once unread bytes wait, False after `timeout_ms` without any."""
        device = self._device
        try:
            return device is not None and is_readable(device.fileno(), timeout_ms)
        except LOST:  # `taken` notices that the device has gone, and reports it
            return False

    def put(self, data: bytes, patience_s: float = 0.0) -> bool:
        """See `ByteRoad.put`: bytes that a full line does not accept within `patience_s` are
        lost.
        """
        device = self._device
        if device is None:
            return False
        # pyserial's own write, asked not to wait, spins for ever on a full line.
        deadline = self._clock.within(patience_s)
        try:
            while data:
                with contextlib.suppress(BlockingIOError):
                    data = data[os.write(device.fileno(), data) :]
                if not data or deadline.over:
                    break
                select.select([], [device.fileno()], [], deadline.left_s)
        except LOST as error:
            self._lose(_reason(error))
            return False
        return not data

    def drain(self) -> None:
        """Wait until the sent bytes have left the machine, at most MAX_DRAIN_S, and drop those that
        a stalled line has not accepted by then.
        """
        deadline = self._clock.within(MAX_DRAIN_S)
        with contextlib.suppress(OSError, TypeError, termios.error):
            while self._device is not None and self._device.out_waiting:
                if deadline.over:  # with unsent bytes, closing would block for half a minute
                    self._device.reset_output_buffer()
                    return
                self._clock.sleep(DRAIN_LOOK_S)

    def _lose(self, why: str) -> None:
        super()._lose(why)
        self._shut()

    def _shut(self) -> None:
        device = self._device
        self._device = None
        if device is not None:
            with contextlib.suppress(*LOST):
                device.close()

    def close(self) -> None:
        """Close the port."""
        self._shut()


class SerialRoadApart(SerialRoad):
    """A SerialRoad whose bytes a separate process reads and stamps. This process opens the port and
    writes to it.

    Raises InputError where the port cannot be opened at the start, MachineError where it is not
    there.
    """

    stamped = True
    _given: serial.Serial | None = None  # the device that the process reads

    def __init__(
        self,
        port: str,
        baud: int,
        use: RoadUse = ATTITUDES,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        super().__init__(port, baud, use, notices, clock)
        self._reader = ReaderProcess(self._notices, clock=clock)

    def await_ready(self) -> None:
        """Wait, not for long, until the separate process is ready to read."""
        self._reader.await_ready()

    def _read(self, device: serial.Serial, timeout_ms: int) -> list[RawMessage]:
        if self._given is not device:
            self._given = device
            self._reader.read(device=device.fileno())
        if self._reader.wait(timeout_ms):
            records = self._reader.take()
        else:
            records = []
        for record in records:
            if record.gone is not None:
                self._lose(record.gone)
        return [record.message for record in records if record.message is not None]

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once something unread has come, False after `timeout_ms` without it."""
        return self._device is not None and self._reader.wait(timeout_ms)

    def _shut(self) -> None:
        # The process must let go of the device, or the port would stay open and locked.
        if self._given is not None:
            self._given = None
            self._reader.read()
        super()._shut()

    def close(self) -> None:
        """Close the port, and end the process."""
        super().close()
        self._reader.close()


class FrameSplitter(wire.StreamDecoder):
    """A StreamDecoder that also stores the newest MAX_LOOKED_AT bytes as they came (`recent`)."""

    def __init__(self) -> None:
        super().__init__()
        self.recent = b""

    def frames(self, chunk: bytes) -> list[bytes]:
        """See `StreamDecoder.frames`."""
        self.recent = (self.recent + chunk)[-MAX_LOOKED_AT:]
        return super().frames(chunk)


class SerialDecoder(Decoder):
    """Divides bytes into COBS frames, each ended by 0x00, and decodes the packets in them."""

    def __init__(self, sent: SentAttitudes = AS_SENT) -> None:
        self.conventions = sent.conventions
        self._decode = sent.decoder(wire.decode_frame)
        self.begin()

    def begin(self) -> None:
        """See `Decoder.begin`."""
        self._splitter = FrameSplitter()

    def whole(self, chunk: RawMessage) -> list[RawMessage]:
        """See `Decoder.whole`."""
        return pieces(chunk, self._splitter.frames(chunk.parts[0]))

    def declares_discontinuity(self, message: bytes) -> bool:
        """See `Decoder.declares_discontinuity`."""
        return wire.frame_declares_discontinuity(message)

    @property
    def unended(self) -> bytes:
        """See `StreamDecoder.unended`."""
        return self._splitter.unended

    def event(self, message: bytes) -> wire.Event:
        """The event of a frame; a `Refusal` where it is none."""
        # A packet that was sent without COBS is cut at its zeros into frames that mean nothing. So
        # the bytes as they came are searched for one, to name that fault.
        event = self._decode(message)
        if not isinstance(event, wire.Refusal) or event.reason != "format":
            return event
        unframed = unframed_packet(self._splitter.recent)
        if unframed is None:
            return event
        return wire.named_refusal("format", "not COBS", unframed, wire.FRAME_FORM)


class SerialLink(StreamLink):
    """COBS frames on a serial port, both ways.

    Raises InputError where the port cannot be opened at the start, MachineError where it is not
    there.
    """

    two_way = True
    road_kind: ClassVar[type[SerialRoad]] = SerialRoad
    _road: SerialRoad
    _decoder: SerialDecoder

    def __init__(
        self,
        port: str,
        baud: int,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
        *,
        sent: SentAttitudes = AS_SENT,
    ) -> None:
        road = self.road_kind(port, baud, ATTITUDES, notices, clock)
        super().__init__(road, SerialDecoder(sent))
        self._baud = baud

    @property
    def trouble(self) -> str:
        """A line about bytes that came and contain no end of a frame; "" without such bytes."""
        unended = self._decoder.unended
        if unended:
            return f"{self.endpoint}: {wire.unended_line(unended)}"
        return ""

    def _begin(self) -> None:
        """Begin anew after a gap, here and, by a 0x00, with the other side's next frame."""
        super()._begin()
        self.send_bytes(wire.DELIMITER)

    def send(self, packet: wire.Packet) -> None:
        """Send a packet without waiting; bytes that the line does not accept at once are lost."""
        self.send_bytes(wire.frame(packet))

    def send_bytes(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Send bytes without a frame; see `ByteRoad.put`."""
        return self._road.put(data, patience_s)

    def drain(self) -> None:
        """See `SerialRoad.drain`."""
        self._road.drain()

    def wire_ns(self, packet: wire.Packet) -> int:
        """How long a packet's frame takes at this baud rate, ns."""
        return (len(wire.encode(packet)) + FRAMING_BYTES) * BITS_PER_BYTE * NS_PER_S // self._baud


class SerialApart(SerialLink):
    """A SerialLink whose bytes a separate process reads and stamps; they are decoded here."""

    road_kind = SerialRoadApart


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def opening_refusal(where: str, error: BaseException, port: str) -> HilstarError:
    """The error to raise for a port that could not be opened: a NotThereError where the device, or
    the server of a network port, is not there, else an InputError.
    """
    if getattr(error, "errno", None) in NOT_THERE:
        if not port.startswith("/") and Path("/dev", port).exists():
            return InputError(f"{where}: no such file; write /dev/{port}")
        here = ", ".join(serial_ports()) or "none"
        return NotThereError(
            f"{where}: no such device; plug it in, or write another serial port (there now: {here})"
        )
    if "://" in port and NO_SERVER.search(str(error)):
        return NotThereError(
            f"{where}: {one_line(str(error))}; start the server of that port, or write another port"
        )
    return InputError(f"{where}: {_opening_fault(error, port)}")


def _opening_fault(error: BaseException, port: str) -> str:
    """A text that says why a port that is there could not be opened, and what to do."""
    text = str(error).lower()
    if "permission" in text:
        instead = "join the group that owns it (often dialout)"
    elif "lock" in text or "resource temporarily" in text:
        instead = "stop the program that has it"
    elif isinstance(error, ValueError):
        instead = "write a baud rate that the port supports, such as 115200 or 921600"
    else:
        instead = (
            "write the serial port, such as /dev/ttyUSB0 (ls /dev/serial/by-id lists them), not"
            f" {port!r}"
        )
    return f"{' '.join(str(getattr(error, 'strerror', None) or error).split())}; {instead}"


def read_lines(
    port: str, baud: int, seconds: float, clock: HostClock = HOST_CLOCK
) -> Iterator[tuple[int, bytes]]:
    """The host time and the text of each line that arrives within `seconds`. The time is monotonic,
    ns, from which the line's time on the wire is subtracted: that of its first bit.

    Raises InputError where the port cannot be opened, or disappears.
    """
    name = f"serial:{port}@{baud}"
    try:
        device = serial.Serial(port, baud, timeout=READ_S, exclusive=True)
    except (OSError, ValueError, OverflowError) as error:
        raise opening_refusal(name, error, port) from error
    with device:
        device.reset_input_buffer()
        end = clock.within(seconds)
        line = b""
        while not end.over:
            try:
                byte = device.read(1)
            except (OSError, TypeError) as error:
                raise InputError(
                    f"{name}: disconnected ({error}); plug it in and start again"
                ) from error
            if byte == b"\n":
                wire_ns = (len(line) + 1) * BITS_PER_BYTE * NS_PER_S // baud
                yield clock.now_ns() - wire_ns, line.strip()
                line = b""
            else:
                line = (line + byte)[-MAX_LINE_BYTES:]


class RtsLine:
    """The output line RTS of a port, such as "/dev/ttyUSB0" or a URL of pyserial. At rest it is
    cleared, or set where `active_high` is False.

    Raises InputError where the port cannot be opened, or has no such line. The system itself may
    set RTS for a moment while it opens a port.
    """

    def __init__(self, port: str, active_high: bool) -> None:
        self.port = port
        self._active_high = active_high
        self._device: serial.SerialBase | None = None
        try:
            self.open()
        except (*LOST, OverflowError) as error:
            if self._device is None:
                raise opening_refusal(f"[sync] port = {port}", error, port) from error
            self.close()
            fault = (
                f"has no line RTS ({one_line(str(error))}); write a serial port with modem lines,"
                " such as /dev/ttyUSB0"
            )
            raise InputError(f"[sync] port = {port}: {fault}") from error

    @property
    def is_open(self) -> bool:
        """Whether the port is open, so that RTS can be set."""
        return self._device is not None

    def open(self) -> None:
        """Open the port, with the line at rest. Raises one of LOST."""
        with warnings.catch_warnings():
            # pyserial itself uses deprecated methods of threads
            warnings.simplefilter("ignore", DeprecationWarning)
            device = serial.serial_for_url(self.port, do_not_open=True, exclusive=True)
            device.rts = not self._active_high
            try:
                device.open()
            except LOST:
                _shut(device)
                raise
        self._device = device
        # Set again, as `open` hides the error of a port without RTS, which this raises.
        device.rts = not self._active_high

    def set(self, active: bool) -> None:
        """Bring the line to its active level, or to rest. Raises one of LOST."""
        if self._device is None:
            raise OSError("the port is closed")
        self._device.rts = active == self._active_high

    def close(self) -> None:
        """Close the port with the line at rest."""
        device = self._device
        self._device = None
        if device is not None:
            with contextlib.suppress(*LOST):
                device.rts = not self._active_high
            _shut(device)


def _shut(device: serial.SerialBase) -> None:
    """Close a port, and the socket that pyserial does not close where its other side has gone."""
    behind = getattr(device, "_socket", None)
    with contextlib.suppress(*LOST):
        device.close()
    if behind is not None:
        behind.close()
