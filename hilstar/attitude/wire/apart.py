"""A separate process that reads a link, so that no stamp waits for Python's lock: its owner's end,
and the records between.

The contract:
1. This process gives a `ReadOrder`: a ZeroMQ stream to open, an open device to read (its descriptor
   goes along), or nothing to
   read any more. A new order replaces the last one.
2. The other process (`apart_child`) stamps each message and hands it over in a record that carries
   the order's number. Records
   of an earlier order are dropped here.
3. It sends a sign of life every 0.1 s. Where it ends or hangs, a notice says so, and it is
   restarted with the same order,
   however seldom or briefly it is looked at from here.
4. It ends with this process, however this one ends.
5. It has real-time priority where that is allowed, but never where it runs a user's code.
"""

import contextlib
import math
import os
import pickle
import select
import socket
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import msgspec

from hilstar.attitude.wire.roads import LinkCounts, RawMessage
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, BackOff, HostClock
from hilstar.basics.units import NS_PER_S

CHILD = "hilstar.attitude.wire.apart_child"
LENGTH = struct.Struct("<I")  # bytes of the record that follows
MAX_RECORD_BYTES = 1 << 27  # 64 parts (zmq_socket) of a few MB
MAX_TAKEN_BYTES = 1 << 20  # in one go
MIN_BACK_OFF_S = 0.05
MAX_BACK_OFF_S = 1.0
STEADY_S = 10 * MAX_BACK_OFF_S
HUNG_S = 0.4  # a sleeping process without a sign of life for this long hangs
STALLED_S = 3.0  # a runnable process may wait this long for a core
LOOPS_S = 1.0  # CPU that a process takes without a sign of life: it had a core, and did not return
# between two looks, of what counts as silence: this process may have been stopped itself
MAX_LOOK_S = 0.1
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
STARTS_S = 30.0  # to start, on a machine whose cores are all busy
READY_WITHIN_S = 5.0
ENDS_WITHIN_S = 0.3  # in order; a signal leaves a command a second for all its ends


class RawLink(Protocol):
    """What the other process reads: messages as they arrive, not decoded."""

    @property
    def link_counts(self) -> LinkCounts:
        """What it counts."""

    def wait_for_message(self, timeout_ms: int) -> bool:
        """Whether something waits."""

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """The messages so far; waits at most `timeout_ms`. Raises OSError where a device no
        longer answers.
        """

    def close(self) -> None:
        """Close this process's end of it."""


OpenStream = Callable[..., RawLink]  # its only argument: notices


class ReadOrder(NamedTuple):
    """What to read from now on: a stream to open; or the device whose descriptor goes along; or
    nothing.
    """

    number: int
    stream: OpenStream | None = None
    device: bool = False
    runs_user_code: bool = False


class Record(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the other process hands over, of one order. A record without anything is a sign of life.

    `gone` says why the device no longer answers, `counts` what the counts have grown by since the
    last record that had them, `end` why the process ends. A `lasting` notice is told, another only
    mentioned.
    """

    order: int = 0
    message: RawMessage | None = None
    gone: str | None = None
    counts: LinkCounts | None = None
    notice: tuple[str, str, str] | None = None
    lasting: bool = True
    end: str | None = None

    def told_to(self, notices: Notices) -> bool:
        """Passes the record on where it is a notice; whether it is one."""
        if self.notice is not None and self.lasting:
            notices.tell(*self.notice)
        elif self.notice is not None:
            notices.mention(*self.notice[:2])
        return self.notice is not None


_encoder, _decoder = msgspec.msgpack.Encoder(), msgspec.msgpack.Decoder(Record)


def pack(record: Record) -> bytes:
    """A record's bytes, its length ahead."""
    body = _encoder.encode(record)
    return LENGTH.pack(len(body)) + body


class RecordStream:
    """Puts records together again from what a stream brings, in order, however they were cut on
    their way.
    """

    def __init__(self) -> None:
        self._kept = bytearray()

    def feed(self, chunk: bytes) -> Iterator[Record]:
        """The records that `chunk` completes. Raises ValueError for what `pack` does not write."""
        self._kept += chunk
        at = 0
        while len(self._kept) - at >= LENGTH.size:
            (count,) = LENGTH.unpack_from(self._kept, at)
            if count > MAX_RECORD_BYTES:
                raise ValueError(f"a record of {count} bytes")
            begin = at + LENGTH.size
            if len(self._kept) - begin < count:
                break
            at = begin + count
            try:
                yield _decoder.decode(self._kept[begin:at])
            except msgspec.DecodeError as error:
                raise ValueError(f"not a record: {error}") from error
        del self._kept[:at]


def process_state(stat: str) -> tuple[str, float]:
    """What a process does ("R" runs or waits for a core), and its own CPU time, s, by its
    /proc/PID/stat (proc(5)).
    """
    # the name, in brackets, may have blanks and brackets of its own
    fields = stat.rpartition(")")[2].split()
    user_ticks, system_ticks = int(fields[11]), int(fields[12])
    return fields[0], (user_ticks + system_ticks) / TICKS_PER_S


def why_hung(is_starting: bool, state: str, silent_s: float, used_s: float) -> str:
    """Why a process that has been silent for longer than it may be hangs; "" where it may be
    waiting for a core. `used_s` is the CPU time that it has taken since it should have spoken.
    """
    if is_starting:
        return f"no sign of life for {STARTS_S:g} s"
    if state != "R":
        return f"no sign of life for {HUNG_S:g} s"
    if used_s > LOOPS_S:
        return f"it took {used_s:.1f} s of a core over one message, and did not return"
    if silent_s > STALLED_S:
        return f"no sign of life for {STALLED_S:g} s"
    return ""


class ReaderProcess:
    """Runs the process that reads a link: starts it, gives it its order, and restarts it where it
    ended or hangs.

    `generation` counts its starts.
    """

    def __init__(
        self,
        notices: Notices,
        module: str = CHILD,
        clock: HostClock = HOST_CLOCK,
        name: str = "the attitude receiver",
    ) -> None:
        self.generation = 0
        self._name = name
        self._notices = notices
        self._module = module
        self._clock = clock
        self._order = ReadOrder(0)
        self._file = -1
        self._process: subprocess.Popen[bytes] | None = None
        self._wire: socket.socket | None = None
        self._stream = RecordStream()
        self._why = ""
        self._ready = False
        self._silent_s = 0.0
        self._looked_ns = clock.now_ns()
        self._busy_from_s = math.nan
        self._trouble = ""
        self._again = BackOff(MIN_BACK_OFF_S, MAX_BACK_OFF_S, clock)
        self._begin()

    def _begin(self) -> None:
        self.generation += 1
        self._steady = self._clock.within(STEADY_S)
        self._why = ""
        self._stream = RecordStream()
        self._ready, self._silent_s, self._looked_ns = False, 0.0, self._clock.now_ns()
        self._opened, self._busy_from_s = 0, math.nan  # the number of the order that it carries out
        wire, its_wire = socket.socketpair()
        wire.setblocking(False)
        self._wire = wire
        command = [sys.executable, "-m", self._module, str(its_wire.fileno()), str(os.getpid())]
        try:
            # In a session of its own: a Ctrl-C is for the process that shows stars.
            self._process = subprocess.Popen(
                command,
                pass_fds=[its_wire.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
        except OSError as error:
            self._ended(str(error))
        finally:
            its_wire.close()
        self._give()

    def _give(self) -> None:
        """Send the order; it is lost where the process has ended, which `take` notices."""
        if self._wire is not None and self._order.number:
            line = pickle.dumps(self._order).hex().encode() + b"\n"
            with contextlib.suppress(OSError):
                socket.send_fds(self._wire, [line], [self._file] if self._order.device else [])

    def read(
        self,
        stream: OpenStream | None = None,
        device: int | None = None,
        *,
        runs_user_code: bool = False,
    ) -> None:
        """Order a stream to be opened, or a device, whose descriptor this process keeps; with
        neither, the device is let go.
        """
        self._order = ReadOrder(self._order.number + 1, stream, device is not None, runs_user_code)
        self._file = -1 if device is None else device
        self._give()

    def wait(self, timeout_ms: float) -> bool:
        """True once the process has said something that was not taken, or has ended; begins it
        again where that is due.
        """
        if self._wire is None and self._again.over:
            self._begin()
        if self._wire is None:
            self._clock.sleep(min(self._again.left_s, timeout_ms / 1000))
            return False
        poll = select.poll()
        poll.register(self._wire, select.POLLIN)
        is_heard = bool(poll.poll(timeout_ms))
        now_ns = self._clock.now_ns()
        passed_s = (now_ns - self._looked_ns) / NS_PER_S
        self._looked_ns = now_ns
        self._silent_s = (
            0.0 if is_heard else self._silent_s + min(passed_s, max(timeout_ms / 1000, MAX_LOOK_S))
        )
        if self._silent_s > (STARTS_S if self._starting else HUNG_S):
            self._look_closely()
        else:
            self._busy_from_s = math.nan
        return is_heard

    def _look_closely(self) -> None:
        """End a process that is silent, unless it may be waiting for a core."""
        state, cpu_s = self._state()
        if math.isnan(self._busy_from_s):
            self._busy_from_s = cpu_s
        why = why_hung(self._starting, state, self._silent_s, cpu_s - self._busy_from_s)
        if why:
            self._ended(why)

    def _state(self) -> tuple[str, float]:
        """What Linux says that the process does ("R" runs or waits for a core), and its CPU
        time, s.
        """
        with contextlib.suppress(OSError, IndexError, ValueError):
            if self._process is not None:
                return process_state(Path(f"/proc/{self._process.pid}/stat").read_text())
        return "", 0.0

    @property
    def _starting(self) -> bool:
        """Whether it still imports what it needs: its own modules, or a user's, which its order
        names.
        """
        return not self._ready or (
            self._order.runs_user_code and self._opened != self._order.number
        )

    @property
    def trouble(self) -> str:
        """Why the process reads nothing now, or has just begun to again; "" while it reads."""
        if self._silent_s > HUNG_S and not self._starting:
            return f"{self._name} does not return"
        return self._trouble

    def await_ready(self) -> None:
        """Wait until the process has imported what it needs; not for long, and not for one that
        failed.
        """
        deadline = self._clock.within(READY_WITHIN_S)
        while not self._ready and self._wire is not None and not deadline.over:
            if self.wait(READY_WITHIN_S * 1000):
                self.take()

    def take(self) -> list[Record]:
        """What has come of the order, without waiting; notices are passed on here."""
        if self._wire is None:
            return []
        try:
            chunk = self._wire.recv(MAX_TAKEN_BYTES)
        except BlockingIOError:
            return []
        except OSError:  # it ended before it had read all that it was given
            chunk = b""
        if not chunk:
            self._ended("")
            return []
        taken: list[Record] = []
        try:
            for record in self._stream.feed(chunk):
                self._ready, self._opened = True, max(self._opened, record.order)
                if not self._starting:
                    self._trouble = ""
                if record.end is not None:
                    self._why = record.end
                elif record.order == self._order.number != 0 and not record.told_to(self._notices):
                    taken.append(record)
        except ValueError as error:
            self._ended(str(error))
        return taken

    def _ended(self, why: str) -> None:
        code = self._stop(0.0)
        self._again.put_off(anew=self._steady.over)
        why = self._why or why or (f"signal {-code}" if code < 0 else f"exit code {code}")
        self._trouble = f"{self._name} stopped ({why}) and is being restarted"
        self._notices.tell("receiver-failed", f"{self._name} stopped ({why}); restarting it")

    def _stop(self, patience_s: float) -> int:
        wire = self._wire
        self._wire = None
        if wire is not None:
            wire.close()
        process = self._process
        self._process = None
        if process is None:
            return 0
        try:
            return process.wait(patience_s or MIN_BACK_OFF_S)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()

    def close(self) -> None:
        """End the process."""
        self._stop(ENDS_WITHIN_S)
