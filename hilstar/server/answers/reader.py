"""A tracker's answers, read by a process apart: a tracker that is dead, silent, babbling or lying
never disturbs a frame.

The other process (`hilstar.attitude.wire.apart_child`) opens the road, asks, stamps, decodes, and
hands over answers and counts of what it refused. It decodes at most MAX_BYTES_PER_S, for at most
WORK_SHARE of the time, and gives at most MAX_ANSWERS_PER_S; the rest is counted as `flood`: noise
in which a frame may begin at every byte would otherwise take a whole core. What cannot end is read
no faster than a chunk each FLOOD_REST_S: a core that only reads and drops is missing to the frames.
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
PIECE_BYTES = 4096  # decoded in one go, of what is no message
# no tracker says more; 1000 decoded here would delay one frame in ten by a millisecond or two
MAX_ANSWERS_PER_S = 200
FLOOD = "flood"
FLOOD_REST_S = 0.01
CHUNK_BYTES, LOOK_MS = 65_536, 100
MAX_DETAILS = 20  # reasons whose newest example is kept
HELD_S = 3.0  # for so long after its last byte a tracker's connection holds the line


class HandedOver(msgspec.Struct, frozen=True, omit_defaults=True):
    """What the other process decoded: an answer, or counts of refusals with an example of each.

    `trouble` is what is wrong with the line from now on, "" for nothing; None where that is as
    before.
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
    """What the other process is to read, and how."""

    settings: AnswersSettings
    folder: Path
    q_body_to_cam: Components | None

    def open(self, notices: Notices, clock: HostClock = HOST_CLOCK) -> ByteRoad:
        """The road. Raises InputError where it cannot be opened."""
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
        """The road, at a run's start: where a file is to come, nothing else may be there. Raises
        InputError as `open`.
        """
        if self.settings.source == "file":
            refuse_no_file(self.folder / str(self.settings.path))
        return self.open(notices)

    def decoder(self, messages: bool) -> AnswerDecoder:
        """The decoder of what comes. Raises InputError."""
        return AnswerDecoder(self.settings, self.q_body_to_cam, messages, self.folder)


class DecodingLink:
    """In the other process: the road, its bounds, its questions, and what the bytes say, each
    message a `HandedOver`.
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
        """What the road counts."""
        return self._road.link_counts

    def wait_for_message(self, timeout_ms: int) -> bool:
        """Never known before it is read."""
        return False

    def taken(self, timeout_ms: int) -> list[RawMessage]:
        """What came and what it says; waits at most `timeout_ms`."""
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
            begun_ns = self._clock.now_ns()
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
            self._work_left_s -= (self._clock.now_ns() - begun_ns) / NS_PER_S
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


class AnswersApart(Closing):
    """A bench's answers, an `AnswerSource`: the other process is started at once, and restarted
    where it ends.

    Raises InputError where the road cannot be opened, or a Python function cannot be loaded.
    """

    def __init__(self, plan: ReadPlan, notices: Notices, clock: HostClock = HOST_CLOCK) -> None:
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
        """Why nothing is read now, "" while answers are: then it is not the tracker that is
        silent.
        """
        return self._process.trouble

    def await_ready(self) -> None:
        """Wait until the process reads; not for long."""
        self._process.await_ready()

    def take(self, timeout_ms: float = 0.0) -> list[Answer]:
        """The answers since the last call, oldest first; waits at most `timeout_ms` for the
        first.
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
            self.details = dict(list({**self.details, **handed.details}.items())[-MAX_DETAILS:])
        return answers

    def refusals(self) -> dict[str, int]:
        """How much was refused so far, by reason."""
        return dict(self._refused)

    def trouble(self) -> str:
        """What is wrong with the tracker's line for as long as it lasts, "" while nothing is."""
        return self._trouble

    def close(self) -> None:
        """End the process."""
        self._process.close()


def recorded_answers(
    plan: ReadPlan, decoder: AnswerDecoder, path: Path
) -> Iterator[Answer | RefusedAnswer]:
    """The answers in a file of recorded bytes. Raises InputError where it cannot be read."""
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
    """The answers of an open road, read in this process for so long; the tracker is asked where
    it has to be.
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
    """The answers that a bench file in `folder` names. Raises InputError where it names none, or
    they cannot be opened.
    """
    if config.answers is None:
        raise InputError(
            'the bench file has no [answers]; write [answers] with source = "serial" or the like'
        )
    return AnswersApart(ReadPlan(config.answers, folder, config.tracker.q_body_to_cam), notices)
