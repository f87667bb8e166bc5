"""Faults over ZeroMQ: a message is a JSON object with the keys of a scenario's `[[fault]]`, or starts or stops one by name.

`{"start": "NAME"}` begins a fault of the scenario, `{"stop": "NAME"}` ends any. A message that is wrong, or one too many, is
refused and counted; nothing of it is kept.
"""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

import msgspec

from hilstar.attitude.wire.keys import NO_KEYS, CurveKeys
from hilstar.attitude.wire.zmq_stream import ZmqReceiver
from hilstar.bench.faults.desk import FaultDesk
from hilstar.bench.faults.kinds import fault_of
from hilstar.errors import InputError, shortened
from hilstar.notices import Notices
from hilstar.run.record.flood_sieve import Allowance

STREAM = "stream"
POLL_MS = 50
RETRY_S = 0.5
MAX_MESSAGE_BYTES = 16_384
# A fault costs time to prepare and room in the ledger: that many at once, and that many each second after.
MAX_BURST, MAX_PER_S = 50, 10
FORM = 'write a JSON object with kind and name, {"start": "NAME"} or {"stop": "NAME"}'


class FaultLink(ZmqReceiver):
    """The socket that messages come in through."""

    max_part_bytes = MAX_MESSAGE_BYTES


def act(desk: FaultDesk, raw: bytes) -> None:
    """Do what a message asks for. Raises InputError for one that is wrong, or that cannot be done."""
    try:
        message: Any = msgspec.json.decode(raw)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise InputError(f"a message is no JSON ({shortened(error)}); {FORM}") from error
    if not isinstance(message, dict):
        raise InputError(f"a message is {type(message).__name__}, no object; {FORM}")
    for verb in ("start", "stop"):
        if verb in message:
            name = message[verb]
            if len(message) > 1 or not isinstance(name, str):
                raise InputError(f"{shortened(message)}: {FORM}")
            desk.start(name, STREAM) if verb == "start" else desk.stop(name, STREAM)
            return
    desk.ask(fault_of(message), STREAM)


class FaultStream:
    """Listens on a thread of its own while it is open. Raises InputError where the endpoint cannot be used."""

    def __init__(
        self, desk: FaultDesk, endpoint: str, *, bind: bool = False, keys: CurveKeys = NO_KEYS, notices: Notices | None = None
    ) -> None:
        self.messages = 0
        self.refused: Counter[str] = Counter()
        self._desk, self._notices = desk, Notices() if notices is None else notices
        self._link = FaultLink(endpoint, bind=bind, keys=keys, notices=self._notices)
        self._allowance = Allowance(MAX_BURST, MAX_PER_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-faults", daemon=True)
        self._thread.start()

    @property
    def endpoint(self) -> str:
        """Where it listens."""
        return f"{self._link.verb} {self._link.endpoint}"

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                for each in self._link.taken(POLL_MS):
                    self._take(each.host_ns, each.parts[-1])
            except Exception as error:  # whatever it is: the run goes on, and so does this
                self._notices.tell("fault-stream", f"the stream of faults failed ({type(error).__name__}: {error}); going on")
                self._stop.wait(RETRY_S)

    def _take(self, host_ns: int, raw: bytes) -> None:
        self.messages += 1
        if not self._allowance.take(host_ns):
            self._refuse("too-many", f"more than {MAX_PER_S} messages a second; send fewer")
            return
        try:
            act(self._desk, raw)
        except InputError as error:
            self._refuse("refused", str(error))

    def _refuse(self, reason: str, detail: str) -> None:
        self.refused[reason] += 1
        self._notices.tell("fault-refused", f"fault refused: {shortened(detail, 300)}")

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join()
        self._link.close()

    def summary(self) -> dict[str, int]:
        """How many messages came, and how many were refused."""
        return {
            "messages": self.messages,
            "refused": sum(self.refused.values()),
            "dropped_unread": self._link.link_counts.flooded,
        }
