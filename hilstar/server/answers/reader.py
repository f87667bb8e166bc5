"""Reads a tracker's answers in a separate process, so that a tracker that is dead, silent or
babbling never delays a frame.

The other process (`hilstar.attitude.wire.apart_child`) opens the line (a `ByteRoad`), polls the
tracker, stamps and decodes its bytes, and passes on answers and counts of refusals. It decodes at
most MAX_BYTES_PER_S, for at most WORK_SHARE of a core, and passes on at most MAX_ANSWERS_PER_S;
the rest is counted as `flood`. Otherwise noise in which a frame may begin at every byte would take
a whole core. During a flood it rests FLOOD_REST_S after each read, because the display needs the
core.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from hilstar.attitude.wire.apart import ReaderProcess
from hilstar.attitude.wire.endpoint import UdpPlace
from hilstar.attitude.wire.file_road import FileRoad, refuse_no_file
from hilstar.attitude.wire.keys import CurveKeys
from hilstar.attitude.wire.roads import ANSWERS, ByteRoad, LinkCounts, RawMessage
from hilstar.attitude.wire.serial_link import SerialRoad
from hilstar.attitude.wire.source import Components
from hilstar.attitude.wire.tcp import TcpRoad
from hilstar.attitude.wire.udp import UdpRoad
from hilstar.attitude.wire.zmq_links import ZmqRoad
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.process.closing import Closing
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.process.user_code import PREFIX
from hilstar.basics.reading import open_regular
from hilstar.basics.units import NS_PER_S
from hilstar.server.answers.answer import Answer
from hilstar.server.answers.formats import AnswerDecoder, RefusedAnswer
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.config.answers import AnswersSettings, answers_place, host_and_port

ZMQ_ENDPOINT = "tcp://127.0.0.1:5562"
MAX_BYTES_PER_S, MAX_BURST_BYTES = 500_000, 250_000
WORK_SHARE, MAX_WORK_S = 0.2, 0.1
PIECE_BYTES = 4096  # of a stream are decoded before the limits are checked again
# No tracker sends more; 1000 decoded here would delay one frame in ten by a millisecond or two.
MAX_ANSWERS_PER_S = 200
FLOOD = "flood"
FLOOD_REST_S = 0.01
CHUNK_BYTES, LOOK_MS = 65_536, 100
MAX_DETAILS = 20  # reasons with a stored example
HELD_S = 3.0  # after its last byte a tracker's connection holds the line against a second one


class HandedOver(msgspec.Struct, frozen=True, omit_defaults=True):
    """A message of the reading process: an answer, or the number of refusals by reason (`refused`)
    with an example of each (`details`), or a change of the line's state.

    `trouble` is the line's fault from now on, "" where it has none; None where nothing changed.
    """

    answer: Answer | None = None
    refused: dict[str, int] = {}
    details: dict[str, str] = {}
    trouble: str | None = None


hand_over = msgspec.msgpack.Encoder(enc_hook=np.ndarray.tolist).encode
handed_over = msgspec.msgpack.Decoder(
    HandedOver, dec_hook=lambda kind, numbers: np.array(numbers)
).decode


@dataclass(frozen=True)
class ReadPlan:
    """What the reading process needs: `[answers]`, the bench file's `folder`, and the tracker's
    mounting q_body_to_cam (w, x, y, z), if given.
    """

    settings: AnswersSettings
    folder: Path
    q_body_to_cam: Components | None

    def open(self, notices: Notices, clock: HostClock = HOST_CLOCK) -> ByteRoad:
        """Open the line that `[answers] source` names. Raises InputError if it cannot be opened."""
        settings = self.settings
        if settings.source == "serial":
            return SerialRoad(str(settings.port), settings.baud, ANSWERS, notices, clock)
        if settings.source == "file":
            return FileRoad(self.folder / str(settings.path), ANSWERS, notices, clock)
        if settings.source == "zmq":
            return self._open_zmq(notices, clock)
        place: UdpPlace | tuple[str, int]
        if settings.connect is not None:
            place = host_and_port(settings.connect)
            _, allowed = answers_place(
                msgspec.structs.replace(settings, listen=None, bind=None, port="", endpoint=None)
            )
        else:
            place, allowed = answers_place(settings)
        if settings.source == "udp":
            return UdpRoad(place, allowed, ANSWERS, notices, clock)
        listening = isinstance(place, UdpPlace)
        if isinstance(place, UdpPlace):
            place = (str(place.host), place.port)
        return TcpRoad(place, allowed, ANSWERS, notices, clock, listening=listening, held_s=HELD_S)

    def _open_zmq(self, notices: Notices, clock: HostClock) -> ByteRoad:
        settings = self.settings
        names = (settings.curve_secret_key, settings.curve_server_key, settings.allowed_clients)
        keys = CurveKeys(*(None if name is None else self.folder / name for name in names))
        endpoint = settings.endpoint or ZMQ_ENDPOINT
        bind = settings.bind is True
        try:
            return ZmqRoad(
                endpoint, bind=bind, keys=keys, notices=notices, clock=clock, use=ANSWERS
            )
        except InputError as error:
            raise InputError(f"[answers] endpoint: {error}") from error

    def open_first(self, notices: Notices) -> ByteRoad:
        """Open the line at a run's start. Raises InputError as `open`, and if `path` is a device,
        FIFO, socket or directory.
        """
        if self.settings.source == "file":
            refuse_no_file(self.folder / str(self.settings.path))
        return self.open(notices)

    def decoder(self, messages: bool) -> AnswerDecoder:
        """The decoder of the line's bytes; `messages` as in `AnswerDecoder`. Raises InputError if a
        Python function cannot be loaded.
        """
        return AnswerDecoder(self.settings, self.q_body_to_cam, messages, self.folder)


class DecodingLink:
    """Runs in the reading process: reads and polls the line, keeps the limits of a flood, and
    decodes the bytes. Its messages are encoded `HandedOver`s.
    """

    def __init__(self, plan: ReadPlan, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        self._road = plan.open(notices, clock)
        self._clock = clock
        self._decoder = plan.decoder(self._road.messages)
        settings = plan.settings
        self._question = None if settings.poll_hex is None else bytes.fromhex(settings.poll_hex)
        self._period_s = 1 / settings.poll_hz
        self._next_question = clock.within(0.0)
        self._bytes_left = float(MAX_BURST_BYTES)
        self._answers_left = float(MAX_ANSWERS_PER_S)
        self._work_left_s = MAX_WORK_S
        self._seen_ns = clock.now_ns()
        self._trouble: str | None = None

    @property
    def link_counts(self) -> LinkCounts:
        """The counts of the line's messages and losses."""
        return self._road.link_counts

    def wait_for_message(self, timeout_ms: int) -> bool:
        """Always False: a message exists only after bytes were read and decoded."""
        return False

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """Read and decode what arrives within `timeout_ms`; the messages for the server."""
        if self._question is not None and self._next_question.over:
            self._road.put(self._question)
            self._next_question = self._clock.within(self._period_s)
        if self._question is not None:
            timeout_ms = min(timeout_ms, max(int(self._next_question.left_s * 1000), 1))
        chunks = self._road.taken(timeout_ms)
        now_ns = self._clock.now_ns()
        self._refill(now_ns)
        refused: Counter[str] = Counter()
        details: dict[str, str] = {}
        given: list[RawMessage] = []
        for chunk, data in self._pieces(chunks):
            if len(data) > self._bytes_left or self._work_left_s <= 0:
                refused[FLOOD] += 1
                details[FLOOD] = (
                    f"over {MAX_BYTES_PER_S} bytes a second, or noise that takes too long to"
                    " search: dropped unread"
                )
                continue
            self._bytes_left -= len(data)
            # Not the time that passed: where other work has the core, a tracker's few bytes seem to
            # take long.
            begun_ns = self._clock.thread_cpu_ns()
            for answer in self._decoder.feed(chunk.host_ns, data):
                if isinstance(answer, RefusedAnswer):
                    refused[answer.reason] += 1
                    details[answer.reason] = answer.detail
                elif self._answers_left < 1:
                    refused[FLOOD] += 1
                    details[FLOOD] = f"over {MAX_ANSWERS_PER_S} answers a second"
                else:
                    self._answers_left -= 1
                    given.append(chunk._replace(parts=[hand_over(HandedOver(answer))], sender=None))
            self._work_left_s -= (self._clock.thread_cpu_ns() - begun_ns) / NS_PER_S
        if refused:
            given.append(
                RawMessage(now_ns, [hand_over(HandedOver(refused=dict(refused), details=details))])
            )
            self._clock.sleep(FLOOD_REST_S if refused[FLOOD] else 0.0)
        return given + self._new_trouble(now_ns)

    def _refill(self, now_ns: int) -> None:
        passed_s = (now_ns - self._seen_ns) / NS_PER_S
        self._seen_ns = now_ns
        self._bytes_left = min(self._bytes_left + passed_s * MAX_BYTES_PER_S, MAX_BURST_BYTES)
        self._answers_left = min(
            self._answers_left + passed_s * MAX_ANSWERS_PER_S, MAX_ANSWERS_PER_S
        )
        self._work_left_s = min(self._work_left_s + passed_s * WORK_SHARE, MAX_WORK_S)

    def _new_trouble(self, now_ns: int) -> list[RawMessage]:
        trouble = self._road.trouble
        if trouble == self._trouble:
            return []
        self._trouble = trouble
        return [RawMessage(now_ns, [hand_over(HandedOver(trouble=trouble))])]

    def _pieces(self, chunks: list[RawMessage]) -> Iterator[tuple[RawMessage, bytes]]:
        for chunk in chunks:
            data = chunk.parts[-1]
            if self._road.messages:
                size = max(len(data), 1)
            else:
                size = PIECE_BYTES
            for at in range(0, len(data), size):
                yield chunk, data[at : at + size]

    def close(self) -> None:
        """Close the road."""
        self._road.close()


def newest_details(before: dict[str, str], new: dict[str, str]) -> dict[str, str]:
    """The examples of refusals by reason, of the MAX_DETAILS reasons that came last."""
    earlier = {reason: detail for reason, detail in before.items() if reason not in new}
    return dict([*earlier.items(), *new.items()][-MAX_DETAILS:])


class AnswersApart(Closing):
    """The `AnswerSource` of a bench. It starts the reading process at once, and restarts it if it
    ends.

    `details` has the newest example of each refusal, by reason. Raises InputError where the line
    cannot be opened, or a Python function cannot be loaded.
    """

    def __init__(self, plan: ReadPlan, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
        # Both are tried here, so that a wrong bench file is refused before the run begins.
        with plan.open_first(notices) as tried:
            self.endpoint = tried.endpoint
            messages = tried.messages
        plan.decoder(messages)
        self._refused: Counter[str] = Counter()
        self.details: dict[str, str] = {}
        self._trouble = ""
        form = plan.settings.format
        runs_user_code = form.startswith(PREFIX)
        name = f"the reader of the tracker's answers{f' ({form})' if runs_user_code else ''}"
        self._process = ReaderProcess(notices, clock=clock, name=name)
        self._process.read(stream=partial(DecodingLink, plan), runs_user_code=runs_user_code)

    @property
    def unread(self) -> str:
        """Why the reading process does not read the line now, "" while it does. Tells a failed
        reader from a silent tracker.
        """
        return self._process.trouble

    def await_ready(self) -> None:
        """Wait, for a limited time, until the process reads."""
        self._process.await_ready()

    def take(self, timeout_ms: float = 0.0) -> list[Answer]:
        """The answers since the last call, oldest first. Waits at most `timeout_ms` for a first
        one.
        """
        answers: list[Answer] = []
        for record in self._process.take() if self._process.wait(timeout_ms) else ():
            if record.message is None:
                continue
            handed = handed_over(record.message.parts[0])
            if handed.answer is not None:
                answers.append(handed.answer)
            self._refused.update(handed.refused)
            if handed.trouble is not None:
                self._trouble = handed.trouble
            self.details = newest_details(self.details, handed.details)
        return answers

    def refusals(self) -> dict[str, int]:
        """How many messages or pieces of data were refused since the start, by reason."""
        return dict(self._refused)

    def trouble(self) -> str:
        """The present fault of the tracker's line, "" without a fault."""
        return self._trouble

    def close(self) -> None:
        """End the process."""
        self._process.close()


def recorded_answers(
    plan: ReadPlan, decoder: AnswerDecoder, path: Path
) -> Iterator[Answer | RefusedAnswer]:
    """The answers and refusals in a file of bytes recorded from a tracker's line; their host time
    is 0. Raises InputError if it cannot be read.
    """
    with open_regular(path, "give the bytes that were recorded from the tracker's line") as file:
        while chunk := file.read(CHUNK_BYTES):
            yield from decoder.feed(0, chunk)
    if plan.settings.format == "json":  # the last line may lack its end
        yield from decoder.feed(0, b"\n")


def live_answers(
    plan: ReadPlan,
    link: ByteRoad,
    decoder: AnswerDecoder,
    seconds: float,
    stopped: Callable[[], bool],
    clock: HostClock = HOST_CLOCK,
) -> Iterator[Answer | RefusedAnswer]:
    """The answers and refusals of an open line, read in this process for `seconds` or until
    `stopped()`. Polls the tracker where `poll_hex` is given.
    """
    settings = plan.settings
    begun_ns = clock.now_ns()
    if settings.poll_hex is None:
        question = None
    else:
        question = bytes.fromhex(settings.poll_hex)
    due = clock.within(0.0)
    while not stopped() and clock.now_ns() - begun_ns < seconds * NS_PER_S:
        if question is not None and due.over:
            link.put(question)
            due = clock.within(1 / settings.poll_hz)
        for chunk in link.taken(
            LOOK_MS if question is None else min(LOOK_MS, max(int(due.left_s * 1000), 1))
        ):
            yield from decoder.feed(chunk.host_ns, chunk.parts[-1])


def open_answers(config: BenchConfig, folder: Path, notices: Notices) -> AnswersApart:
    """Start reading the answers that the bench file in `folder` declares. Raises InputError where
    it has no `[answers]`, or the line cannot be opened.
    """
    if config.answers is None:
        raise InputError(
            'the bench file has no [answers]; write [answers] with source = "serial" or the like'
        )
    return AnswersApart(ReadPlan(config.answers, folder, config.tracker.q_body_to_cam), notices)
