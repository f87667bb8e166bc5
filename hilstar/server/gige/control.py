"""The control channel of a GigE Vision camera (GVCP), without I/O: a datagram in, its answer out,
and events.

Laws:
1. `receive` never raises, and gives at most one datagram: to the peer that sent the one it was
   given. What is no command is dropped and counted.
2. Whoever is heard may discover and read. Writes take the control privilege, which one peer has at
   a time; it is that peer's address and port.
3. Images go to the controller's own address alone, to no port before the controller has named it:
   nobody can have a stream sent to another machine.
4. A controller that says nothing for the heartbeat's time has lost the privilege, and its stream
   ends.
5. A command that comes twice with one number (its answer was lost) is answered twice and done once:
   a trigger begins one exposure.
"""

import ipaddress
import struct
from dataclasses import dataclass
from enum import IntEnum

from hilstar.basics.units import NS_PER_MS
from hilstar.server.gige.features import WORD_BYTES
from hilstar.server.gige.registers import (
    CONTROL,
    EXCLUSIVE,
    FIRE_TEST_PACKET,
    HEARTBEAT_MS,
    PACKET_SIZE_MASK,
    PRIVILEGE,
    STREAM_ADDRESS,
    STREAM_PACKET_BYTES,
    STREAM_PORT,
    GvcpStatus,
    RegisterError,
    Registers,
)

PORT = 3956
KEY = 0x42
COMMAND_HEADER = struct.Struct(">BBHHH")
ANSWER_HEADER = struct.Struct(">HHHH")
WORD = struct.Struct(">I")
WRITE = struct.Struct(">II")
READ_MEMORY = struct.Struct(">IHH")
RESEND = struct.Struct(">HHII")
ANSWER_WANTED = 0x01
MAX_DATA_BYTES = 536  # of a command or an answer, by the standard
MAX_RESENT = 4096  # packets of one request
Peer = tuple[str, int]


class ControlCommand(IntEnum):
    """Commands; the number after a command's is its answer's."""

    DISCOVERY = 0x0002
    RESEND = 0x0040
    READ_REGISTERS = 0x0080
    WRITE_REGISTERS = 0x0082
    READ_MEMORY = 0x0084
    WRITE_MEMORY = 0x0086


@dataclass(frozen=True, slots=True)
class Resend:
    """Packets `first` to `last` of a block are asked for again."""

    block: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class FiredPacket:
    """A packet of this many bytes, with its headers, is asked for, to find the largest that
    passes.
    """

    packet_bytes: int


@dataclass(frozen=True, slots=True)
class FeatureCommand:
    """A command feature (AcquisitionStart, AcquisitionStop, TriggerSoftware) was written."""

    name: str


@dataclass(frozen=True, slots=True)
class Released:
    """The controller is gone, or gave the privilege back; `silent` where it just stopped."""

    silent: bool


ControlEvent = Resend | FiredPacket | FeatureCommand | Released


@dataclass(slots=True)
class ControlCounts:
    """Datagrams: commands answered, refused by a status, and those that were no command."""

    commands: int = 0
    refused: int = 0
    dropped: int = 0


class ControlChannel:
    """A camera's control channel over its registers; `take_events` gives what it has to do."""

    def __init__(self, registers: Registers) -> None:
        self.registers = registers
        self.counts = ControlCounts()
        self.controller: Peer | None = None
        self._heard_ns = 0
        self._events: list[ControlEvent] = []
        self._last: tuple[Peer, int, int, bytes] | None = None

    def take_events(self) -> list[ControlEvent]:
        """The events since they were last taken, oldest first."""
        events = self._events
        self._events = []
        return events

    @property
    def destination(self) -> Peer | None:
        """Where images go; None where the controller has named no port."""
        port = self.registers.word(STREAM_PORT) & 0xFFFF
        if self.controller is None or not port:
            return None
        return self.controller[0], port

    @property
    def packet_bytes(self) -> int:
        """Of the stream, with its headers."""
        return self.registers.word(STREAM_PACKET_BYTES) & PACKET_SIZE_MASK

    def is_client(self, peer: Peer) -> bool:
        """Whether a peer is the controller, or where its images go: clients ask for lost packets
        from there (Aravis does).
        """
        return peer in {self.controller, self.destination}

    def tick(self, now_ns: int) -> None:
        """Let a controller go that has been silent for too long."""
        heartbeat_ns = self.registers.word(HEARTBEAT_MS) * NS_PER_MS
        if self.controller is not None and now_ns - self._heard_ns > heartbeat_ns:
            self._release(silent=True)

    def receive(self, data: bytes, peer: Peer, now_ns: int) -> bytes | None:
        """The answer to a peer's datagram at `now_ns`, host time; None where it has none."""
        self.tick(now_ns)
        if peer == self.controller:
            self._heard_ns = now_ns
        if len(data) < COMMAND_HEADER.size or data[0] != KEY:
            self.counts.dropped += 1
            return None
        _, flags, command, size, number = COMMAND_HEADER.unpack_from(data)
        body = data[COMMAND_HEADER.size :]
        if size != len(body) or size > MAX_DATA_BYTES or not number:
            self.counts.dropped += 1
            return None
        if self._last is not None and self._last[:3] == (peer, command, number):
            return self._last[3] if flags & ANSWER_WANTED else None
        self.counts.commands += 1
        try:
            status = GvcpStatus.SUCCESS
            answer = self._obeyed(command, body, peer, now_ns)
        except RegisterError as refusal:
            self.counts.refused += 1
            status = refusal.status
            answer = b""
        if command == ControlCommand.RESEND:
            return None
        head = ANSWER_HEADER.pack(status, (command + 1) & 0xFFFF, len(answer), number)
        if peer == self.controller:
            self._last = peer, command, number, head + answer
        return head + answer if flags & ANSWER_WANTED else None

    def _obeyed(self, command: int, body: bytes, peer: Peer, now_ns: int) -> bytes:
        """The body of a command's answer. Raises RegisterError."""
        registers = self.registers
        if command == ControlCommand.DISCOVERY:
            return registers.discovery()
        if command == ControlCommand.READ_REGISTERS:
            if not body or len(body) % WORD.size:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            addresses = [address for (address,) in WORD.iter_unpack(body)]
            return b"".join(registers.read(address, WORD_BYTES) for address in addresses)
        if command == ControlCommand.READ_MEMORY:
            if len(body) != READ_MEMORY.size:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            address, _, count = READ_MEMORY.unpack(body)
            if count > MAX_DATA_BYTES:
                raise RegisterError(GvcpStatus.INVALID_PARAMETER)
            return WORD.pack(address) + registers.read(address, count)
        if command == ControlCommand.WRITE_REGISTERS:
            return self._written_registers(body, peer, now_ns)
        if command == ControlCommand.WRITE_MEMORY:
            return self._written_memory(body, peer)
        if command == ControlCommand.RESEND:
            self._resend(body, peer)
            return b""
        raise RegisterError(GvcpStatus.NOT_IMPLEMENTED)

    def _written_registers(self, body: bytes, peer: Peer, now_ns: int) -> bytes:
        if not body or len(body) % WRITE.size:
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
        count = 0
        for address, value in WRITE.iter_unpack(body):
            if address == PRIVILEGE:
                self._ask_privilege(value, peer, now_ns)
            else:
                self._check_controller(peer)
                self._write(address, WORD.pack(value), peer)
            count += 1
        return WORD.pack(count)

    def _written_memory(self, body: bytes, peer: Peer) -> bytes:
        if len(body) <= WORD.size:
            raise RegisterError(GvcpStatus.INVALID_PARAMETER)
        self._check_controller(peer)
        (address,) = WORD.unpack_from(body)
        data = body[WORD.size :]
        if address == PRIVILEGE:
            raise RegisterError(GvcpStatus.INVALID_ADDRESS)
        self._write(address, data, peer)
        return WORD.pack(len(data))

    def _write(self, address: int, data: bytes, peer: Peer) -> None:
        value = int.from_bytes(data[:WORD_BYTES], "big")
        if address == STREAM_ADDRESS and value not in {0, int(ipaddress.IPv4Address(peer[0]))}:
            raise RegisterError(GvcpStatus.ACCESS_DENIED)
        self.registers.write(address, data)
        if address == STREAM_PACKET_BYTES and value & FIRE_TEST_PACKET:
            self._events.append(FiredPacket(value & PACKET_SIZE_MASK))
        self._events += [FeatureCommand(name) for name in self.registers.commands]
        self.registers.commands.clear()

    def _ask_privilege(self, value: int, peer: Peer, now_ns: int) -> None:
        if self.controller not in {None, peer}:
            raise RegisterError(GvcpStatus.ACCESS_DENIED)
        wanted = value & (EXCLUSIVE | CONTROL)
        if not wanted:
            if self.controller == peer:
                self._release(silent=False)
            return
        self.controller = peer
        self._heard_ns = now_ns
        self.registers.put_word(PRIVILEGE, wanted)

    def _check_controller(self, peer: Peer) -> None:
        if self.controller != peer:
            raise RegisterError(GvcpStatus.ACCESS_DENIED)

    def _release(self, silent: bool) -> None:
        self.controller = self._last = None
        for address in (PRIVILEGE, STREAM_PORT, STREAM_ADDRESS):
            self.registers.put_word(address, 0)
        self._events.append(Released(silent))

    def _resend(self, body: bytes, peer: Peer) -> None:
        """A request for packets; it has no answer but these."""
        if not self.is_client(peer) or len(body) != RESEND.size:
            return
        _, block, first, last = RESEND.unpack(body)
        first = first & 0xFF_FFFF
        last = last & 0xFF_FFFF
        self._events.append(Resend(block, first, min(last, first + MAX_RESENT - 1)))
