"""Serial ports: the link of COBS frames on a device that may be unplugged and come back, lines
of text, and the RTS output.
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

import serial
from serial.tools import list_ports

from hilstar.attitude.wire import packet as wire
from hilstar.attitude.wire.apart import ReaderProcess
from hilstar.attitude.wire.likeness import MAX_LOOKED_AT, unframed_packet
from hilstar.attitude.wire.links import Arrival, RawMessage, StreamLink
from hilstar.attitude.wire.source import AS_SENT, SentAttitudes
from hilstar.basics.errors import HilstarError, InputError, NotThereError, one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff, HostClock
from hilstar.basics.units import NS_PER_S

DEFAULT_BAUD = 115_200
MIN_BACK_OFF_S = 0.05
MAX_BACK_OFF_S = 0.4  # a device that comes back is opened within a second
MAX_READ_BYTES = 65_536  # in one go
MAX_DRAIN_S, DRAIN_LOOK_S = 0.5, 0.005
BITS_PER_BYTE = 10  # 8N1
FRAMING_BYTES = 2  # the COBS byte and the 0x00
READ_S = 0.05
MAX_LINE_BYTES = 256
# of a port on the network
NO_SERVER = re.compile("refused|timed out|unreachable|No route", re.IGNORECASE)
NOT_THERE = (errno.ENOENT, errno.ENODEV, errno.ENXIO)
# What pyserial raises for a port that is gone: OSError from the system, the others from its own
# port over a network.
LOST = (OSError, TypeError, ValueError)


def serial_target(text: str) -> tuple[str, int] | None:
    """Port and baud rate of "serial:/dev/ttyX@BAUD"; None for any other target. Raises
    InputError.
    """
    if not text.startswith("serial:"):
        return None
    match = re.fullmatch(r"serial:(.+?)(?:@(\d{1,8}))?", text)
    if match is None or not match[1] or "@" in match[1] or (match[2] and not int(match[2])):
        raise InputError(f"{text}: write serial:/dev/ttyX@BAUD, such as serial:/dev/ttyUSB0@921600")
    return match[1], int(match[2] or DEFAULT_BAUD)


def serial_ports() -> list[str]:
    """The serial ports of this machine, each with its description."""
    return [f"{port.device} ({port.description})" for port in sorted(list_ports.comports())]


def adapters() -> list[str]:
    """What the serial ports are, without their names and serial numbers: "FT232R USB UART
    (0403:6001)".
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
    """A port of its own, whose bytes come at once. Raises OSError, ValueError or OverflowError."""
    device = serial.Serial(port, baud, timeout=0, exclusive=True)
    # else a USB adapter buffers for 16 ms; a pty has no such mode
    with contextlib.suppress(OSError, ValueError):
        device.set_low_latency_mode(True)
    return device


class SerialLink(StreamLink):
    """A serial port that is reopened, with back-off, whenever it disappears.

    Raises InputError where the port cannot be opened at the start, MachineError where it is not
    there.
    """

    two_way = True
    verb = "reading"

    def __init__(
        self,
        port: str,
        baud: int,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
        *,
        sent: SentAttitudes = AS_SENT,
    ) -> None:
        super().__init__(notices, clock)
        self.conventions = sent.conventions
        self._decode = sent.decoder(wire.decode_frame)
        self.endpoint = f"serial:{port}@{baud}"
        self._port = port
        self._baud = baud
        self._reopened = 0
        self._decoder = wire.StreamDecoder()
        self._recent = b""
        self._retry = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, clock)
        try:
            self._device: serial.Serial | None = self._open()
        except (OSError, ValueError, OverflowError) as error:  # SerialException is an OSError
            raise opening_refusal(self.endpoint, error, port) from error

    @property
    def reconnects(self) -> int:
        """How often the device came back."""
        return self._reopened

    @property
    def trouble(self) -> str:
        """See `Link.trouble`: the bytes that came, and are no frame."""
        unended = self._decoder.unended
        if unended:
            return f"{self.endpoint}: {wire.unended_line(unended)}"
        return ""

    def _open(self) -> serial.Serial:
        self._decoder = wire.StreamDecoder()
        return open_port(self._port, self._baud)

    def receive(self, timeout_ms: int) -> list[Arrival[wire.Event]]:
        """The frames that have arrived, and only the newest of a flood; waits at most
        `timeout_ms` for the first byte.
        """
        device = self._device
        if device is None:
            self._reopen(timeout_ms)
            return []
        try:
            chunks = self._read(device, timeout_ms)
        except (OSError, TypeError) as error:
            # pyserial raises TypeError for a port closed meanwhile
            self._lose(str(error))
            return []
        waiting: list[RawMessage] = []
        for chunk in chunks:
            self._recent = (self._recent + chunk.parts[0])[-MAX_LOOKED_AT:]
            bodies = self._decoder.frames(chunk.parts[0])
            # frames before the chunk's last were there earlier, and waited for it
            for k, body in enumerate(bodies, 1):
                waiting.append(
                    chunk._replace(parts=[body], timely=chunk.timely and k == len(bodies))
                )
        arrivals: list[Arrival[wire.Event]] = []
        for frame in self._gate.newest(waiting, wire.frame_declares_discontinuity):
            body = frame.parts[0]
            arrivals.append(Arrival(frame.host_ns, self._event(body), body, frame.waited_ns))
        return arrivals

    def _event(self, body: bytes) -> wire.Event:
        """What a frame says. One that says nothing may be a piece of a packet that was not
        framed, cut at its zeros.
        """
        event = self._decode(body)
        if not isinstance(event, wire.Refusal) or event.reason != "format":
            return event
        unframed = unframed_packet(self._recent)
        if unframed is None:
            return event
        return wire.named_refusal("format", "not COBS", unframed, wire.FRAME_FORM)

    def _read(self, device: serial.Serial, timeout_ms: int) -> list[RawMessage]:
        if device.timeout != timeout_ms / 1000:  # setting it costs a tcsetattr
            device.timeout = timeout_ms / 1000
        data = device.read(1)
        data += device.read(min(device.in_waiting, MAX_READ_BYTES)) if data else b""
        now_ns = self._clock.now_ns()
        if data:
            return [RawMessage(now_ns, [data], now_ns)]
        return []

    def wait_for_message(self, timeout_ms: int) -> bool:
        """True once unread bytes wait."""
        device = self._device
        try:
            return device is not None and bool(
                select.select([device.fileno()], [], [], timeout_ms / 1000)[0]
            )
        except (OSError, ValueError, TypeError):  # gone: `receive` notices, and reports it
            return False

    def send(self, packet: wire.Packet) -> None:
        """Send to the other side without waiting: what the line does not take at once is lost."""
        self.send_bytes(wire.frame(packet))

    def send_bytes(self, data: bytes, patience_s: float = 0.0) -> bool:
        """Send bytes as they are, waiting at most `patience_s` while the line is full; False
        where some were lost.
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
        except (OSError, ValueError, TypeError) as error:
            self._lose(str(error))
            return False
        return not data

    def drain(self) -> None:
        """Wait until the bytes sent have left the machine; drop those that a stalled line does
        not take.
        """
        deadline = self._clock.within(MAX_DRAIN_S)
        with contextlib.suppress(OSError, TypeError, termios.error):
            while self._device is not None and self._device.out_waiting:
                if deadline.over:  # closing it would block for half a minute
                    self._device.reset_output_buffer()
                    return
                self._clock.sleep(DRAIN_LOOK_S)

    def wire_ns(self, packet: wire.Packet) -> int:
        """How long a packet's frame takes at this baud rate."""
        return (len(wire.encode(packet)) + FRAMING_BYTES) * BITS_PER_BYTE * NS_PER_S // self._baud

    def _lose(self, why: str) -> None:
        self.link_counts.lost += 1
        self._notices.tell(
            "lost", f"{self.endpoint} disconnected ({one_line(why)}); waiting for it to come back"
        )
        self._shut()
        self._retry.put_off(anew=True)

    def _reopen(self, timeout_ms: int) -> None:
        if not self._retry.over:
            self._clock.sleep(min(self._retry.left_s, timeout_ms / 1000))
            return
        try:
            self._device = self._open()
        except (OSError, ValueError):
            self._retry.put_off()
            return
        self._reopened += 1
        self._notices.tell("back", f"{self.endpoint} is back")
        self.send_bytes(wire.DELIMITER)

    def _shut(self) -> None:
        device = self._device
        self._device = None
        if device is not None:
            with contextlib.suppress(OSError, TypeError):
                device.close()

    def close(self) -> None:
        """Close the port."""
        self._shut()


class SerialApart(SerialLink):
    """A SerialLink whose bytes a process of its own reads and stamps; it is opened, written to and
    decoded here.

    Raises InputError where the port cannot be opened at the start, MachineError where it is not
    there.
    """

    stamped = True
    _given: serial.Serial | None = None  # the device that the process reads

    def __init__(
        self,
        port: str,
        baud: int,
        notices: Notices | None = None,
        clock: HostClock = HOST_CLOCK,
        *,
        sent: SentAttitudes = AS_SENT,
    ) -> None:
        super().__init__(port, baud, notices, clock, sent=sent)
        self._reader = ReaderProcess(self._notices, clock=clock)

    def await_ready(self) -> None:
        """Wait until the device can be read, or for a moment."""
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
        """True once something has come that was not read."""
        return self._device is not None and self._reader.wait(timeout_ms)

    def _shut(self) -> None:
        if self._given is not None:  # else its line would stay open and locked
            self._given = None
            self._reader.read()
        super()._shut()

    def close(self) -> None:
        """Close the port, and end the process."""
        super().close()
        self._reader.close()


def opening_refusal(where: str, error: BaseException, port: str) -> HilstarError:
    """The refusal of a port that could not be opened: a NotThereError where the device is not
    there, else an InputError.
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
    """Why a port that is there could not be opened, and what to do."""
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
    """Host time (monotonic ns, less the time on the wire) and text of each line that arrives within
    `seconds`.

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
    """RTS of a port, such as "/dev/ttyUSB0" or a URL of pyserial; at rest it is cleared, or set
    where `active_high` is false.

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
        """Whether there is a port to pulse."""
        return self._device is not None

    def open(self) -> None:
        """Open the port, with the line at rest. Raises one of LOST."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # pyserial's own, of threads
            device = serial.serial_for_url(self.port, do_not_open=True, exclusive=True)
            device.rts = not self._active_high
            try:
                device.open()
            except LOST:
                _shut(device)
                raise
        self._device = device
        device.rts = not self._active_high  # opening suppresses that a port has no such line

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
    """Close a port, and the socket that pyserial leaves open where its other side has gone."""
    behind = getattr(device, "_socket", None)
    with contextlib.suppress(*LOST):
        device.close()
    if behind is not None:
        behind.close()
