"""The records of a ledger, and the functions that read them: its head, its records in their order,
and the frames that a replay draws again.

There is a record for each frame, event, fault and answer, for each second of the process, and for
messages that were only counted.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from hilstar.attitude.logs.mcap_log import (
    ATTITUDE_TOPIC,
    RUN_METADATA,
    Topics,
    read_chunks,
    read_messages,
    read_metadata,
)
from hilstar.attitude.wire.packet import (
    MAX_PLACE_KM,
    MIN_PLACE_KM,
    Refusal,
    checked_sample,
    rate_refusal,
)
from hilstar.attitude.wire.protocol import NORM_TOLERANCE
from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, cannot_read, printable
from hilstar.basics.reading import NOT_JSON, parse_toml
from hilstar.basics.units import MAX_SPEED_KM_S
from hilstar.server.answers.answer import ReportedStar
from hilstar.server.answers.judge import Judged
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.config.attitude import PACKET_SOURCES
from hilstar.server.bench.frame import Bench
from hilstar.server.pacer import Shown

FRAME_TOPIC, PROCESS_TOPIC, EVENT_TOPIC, COUNT_TOPIC, FAULT_TOPIC = (
    "/frame",
    "/process",
    "/event",
    "/not_kept",
    "/fault",
)
ANSWER_TOPIC = "/answer"
# The outcomes of a frame's pulse. Where the line is lost during a pulse, the pulse counts as "lost"
# and as "skipped".
PULSES = ("sent", "skipped", "lost")
LOST = "sequence"  # the reason in the records of lost packets
# Recorded of a message: every packet is shorter, a simulator's own messages may be cut.
MAX_RAW_BYTES = 1024
MAX_CENTROIDS = 200  # recorded of an answer
HostNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]  # host time, ns; 0 at the machine's start
# Times of another clock, or time differences, ns.
AnyNs = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
Marker = Annotated[int, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
_KINDS: dict[Any, str] = {
    float: "number",
    float | None: "number",
    str: "string",
    bool: "boolean",
} | dict.fromkeys(
    (
        int,
        int | None,
        HostNs,
        HostNs | None,
        AnyNs,
        AnyNs | None,
        Count,
        Count | None,
        Marker | None,
    ),
    "integer",
)
NO_FRAMES = "has no frames; give the ledger of serve or replay --ledger"
MAX_REASONS, MAX_REASON_CHARACTERS = 50, 40


class FrameRecord(msgspec.Struct, kw_only=True, gc=False):
    """One frame. Times in ns: `t_ns` on the timeline, `light_ns` on the sender's clock, the others
    on this host's.

    `q` is q_icrs_to_cam (w, x, y, z) at `light_ns`, when the middle row lights. `rate` (rad/s,
    camera axes) is the turn along which stars are drawn as paths, null where they are points.
    `velocity_km_s` (ICRS, for aberration) and `place_km` (position relative to the Earth) are the
    observer's where the source gives them, else null. `clipped` counts stars that are too bright
    for the monitor, `below_step` stars that are too faint for it, `capped` stars with coarser
    paths. `missed_before` counts the refresh periods just before it without a frame, `missed` those
    of the run so far. `marker` is the state of the photodiode square. `operator` names the
    operator's switches that are on ("blank, grid"; under a blank or a patch `q` is null), `hidden`
    says why the window was not visible; "" for neither. `faults` are the numbers of the faults that
    are on, `fault_since_ns` the times since when.
    """

    frame: Count
    t_ns: AnyNs
    light_ns: AnyNs
    draw_ns: HostNs
    predicted_swap_ns: HostNs | None = None
    swap_ns: HostNs
    timestamp_source: str = "headless"
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    velocity_km_s: tuple[float, float, float] | None = None
    place_km: tuple[float, float, float] | None = None
    attitude_sequence: int | None = None
    attitude_t_ns: AnyNs | None = None
    receive_ns: HostNs | None = None
    age_ns: AnyNs | None = None
    prediction_ns: AnyNs = 0
    stale: bool = False
    stars_drawn: Count = 0
    clipped: Count = 0
    below_step: Count = 0
    capped: Count = 0
    missed_before: Count = 0
    missed: Count = 0
    marker: Marker | None = None
    operator: str = ""
    hidden: str = ""
    faults: tuple[Count, ...] = ()
    fault_since_ns: tuple[AnyNs, ...] = ()


def schema_of(record: type[msgspec.Struct], title: str) -> bytes:
    """The JSON schema of a record class, as bytes, with the name `title`. It has plain types only
    (see `attitude.logs.mcap_log.ATTITUDE_SCHEMA`).
    """
    array = {"type": "array", "items": {"type": "number"}}
    fields = {}
    for f in msgspec.structs.fields(record):
        fields[f.name] = {"type": _KINDS[f.type]} if f.type in _KINDS else array
    if "centroids" in fields:
        fields["centroids"] = {"type": "array", "items": {"type": "array"}}
    return msgspec.json.encode({"title": title, "type": "object", "properties": fields})


class ProcessRecord(msgspec.Struct, kw_only=True):
    """The memory, bytes, and total CPU time, s, of the process at a host time, ns."""

    host_ns: HostNs
    resident_bytes: Count
    cpu_s: float


class EventRecord(msgspec.Struct, kw_only=True):
    """An event of a run (see `hilstar.basics.notices`): host time, ns, its kind, its text
    (`detail`), and the person who caused it (`who`).

    `since_ns` is the host time at which the reported condition began, where that was earlier.
    """

    host_ns: HostNs
    kind: str
    detail: str
    who: str = ""
    since_ns: AnyNs | None = None


class FaultRecord(msgspec.Struct, kw_only=True):
    """The beginning ("start") or end ("end") of a fault, or a fault that fell between two frames
    ("missed"): at host time `host_ns` and `t_ns` of the timeline.

    `number` counts the starts in a run; `who` is "file", "stream" or a person's name. `table` is
    the fault as JSON with the keys of a scenario, `seed` the seed of its random numbers, `folder`
    the folder of its files, and `file_sha256` the SHA-256 of its map.
    """

    host_ns: HostNs
    event: str
    number: Count
    name: str
    kind: str
    who: str
    t_ns: AnyNs
    table: str
    seed: int = 0
    folder: str = ""
    file_sha256: str = ""


class AnswerRecord(msgspec.Struct, kw_only=True):
    """An answer of the tracker: its bytes (`raw`, hexadecimal), its content, and what the display
    lit during its exposure.

    Host times, ns: `host_ns` of its last byte, `middle_ns` of its exposure's middle, as estimated
    on arrival. `t_ns` is the tracker's stamp on the tracker's clock, `light_ns` the exposure's
    middle on the sender's clock. `q` is q_icrs_to_cam (w, x, y, z), `rate` is in rad/s, camera
    axes. `centroids` are [x_px, y_px, dn, hip], `widths_px` the stars' widths in the same order,
    none where the tracker reports none. `verdict` is "right", "wrong" (see `[answers]
    wrong_arcsec`), "invalid" (without an attitude), "unpaired" (no single sky was lit) or
    "unjudged" (compared with nothing; `middle_ns` may be `host_ns`).

    `q_lit` is the mean attitude of the frames `first_frame` to `last_frame`, `residual_arcsec` the
    rotation vector from it to `q`, camera axes.
    """

    host_ns: HostNs
    raw: str
    t_ns: AnyNs | None = None
    q: tuple[float, float, float, float] | None = None
    rate: tuple[float, float, float] | None = None
    valid: bool = True
    mode: str = ""
    stars: Count | None = None
    rms_arcsec: float | None = None
    centroids: tuple[tuple[float, float, float | None, int | None], ...] = ()
    widths_px: tuple[float | None, ...] = ()
    verdict: str = "unpaired"
    middle_ns: AnyNs = 0
    light_ns: AnyNs | None = None
    q_lit: tuple[float, float, float, float] | None = None
    residual_arcsec: tuple[float, float, float] | None = None
    first_frame: Count | None = None
    last_frame: Count | None = None


class CountRecord(msgspec.Struct, kw_only=True):
    """A number of messages that were only counted in the second before `host_ns` (host time, ns):
    of a flood, without room on the disk, or without a message, as pulses.

    `kind` is "packet", "frame", "event", "answer", "pulse" or "lost". `reason` is the reason of a
    refused packet, "accepted" for other packets and answers, an event's kind, one of PULSES for a
    pulse, "no room" for lost messages, or LOST for packets that a gap in their `sequence` shows.
    """

    host_ns: HostNs
    kind: str
    reason: str
    count: Count


class PacketForm(msgspec.Struct, gc=False):
    """The part of a recorded packet that a report needs: whether it was accepted, else the reason,
    and when it was received, host time, ns.
    """

    accepted: bool = True
    reason: str | None = None
    receive_ns: AnyNs | None = None


RunRecord = (
    FrameRecord
    | ProcessRecord
    | PacketForm
    | CountRecord
    | EventRecord
    | FaultRecord
    | AnswerRecord
)


# The topic and the record of each kind that a ledger is given, beside packets.
RECORDS: dict[str, tuple[str, type[msgspec.Struct]]] = {
    "frame": (FRAME_TOPIC, FrameRecord),
    "event": (EVENT_TOPIC, EventRecord),
    "process": (PROCESS_TOPIC, ProcessRecord),
    "count": (COUNT_TOPIC, CountRecord),
    "fault": (FAULT_TOPIC, FaultRecord),
    "answer": (ANSWER_TOPIC, AnswerRecord),
}
_DECODERS: dict[str, msgspec.json.Decoder[Any]] = {
    topic: msgspec.json.Decoder(record) for topic, record in RECORDS.values()
}
_DECODERS[ATTITUDE_TOPIC] = msgspec.json.Decoder(PacketForm)


def frame_record(shown: Shown, light_ns: int, missed: int, below_step: int) -> FrameRecord:
    """The ledger's record of a frame; `light_ns` is on the sender's clock, `missed` counts the
    run's missed frames so far, and `below_step` the stars in view that are too faint for the
    monitor.
    """
    attitude = shown.attitude
    drawn = shown.drawn
    names = (
        "t_ns",
        "draw_ns",
        "predicted_swap_ns",
        "swap_ns",
        "timestamp_source",
        "stale",
        "missed_before",
        "marker",
    )
    record = FrameRecord(
        frame=shown.number,
        light_ns=light_ns,
        stars_drawn=drawn.star_count,
        clipped=len(drawn.clipped_hip),
        below_step=below_step,
        capped=drawn.capped,
        missed=missed,
        operator=shown.on_screen.operator,
        hidden=shown.on_screen.hidden,
        **{name: getattr(shown, name) for name in names},
    )
    if shown.faults:
        record.faults = tuple(active.number for active in shown.faults)
        record.fault_since_ns = tuple(active.since_ns for active in shown.faults)
    record.rate = _numbers(drawn.rate_cam_rad_s)
    if attitude is not None:
        record.q = _numbers(attitude.q_icrs_to_cam)
        record.velocity_km_s = _numbers(attitude.velocity_km_s)
        record.place_km = _numbers(attitude.place_km)
        record.attitude_sequence = attitude.sequence
        record.attitude_t_ns = _within_64_bits(light_ns - attitude.age_ns)
        record.receive_ns = attitude.received_ns
        record.age_ns = _within_64_bits(attitude.age_ns)
        record.prediction_ns = attitude.prediction_ns
    return record


def answer_record(judged: Judged) -> AnswerRecord:
    """The ledger's record of a judged answer."""
    answer = judged.answer
    lit = judged.lit
    record = AnswerRecord(
        host_ns=answer.host_ns,
        raw=answer.raw[:MAX_RAW_BYTES].hex(),
        t_ns=None if answer.t_ns is None else _within_64_bits(answer.t_ns),
        q=_numbers(answer.q_icrs_to_cam),
        rate=_numbers(answer.rate_cam_rad_s),
        valid=answer.valid,
        mode=printable(answer.mode)[:MAX_REASON_CHARACTERS],
        stars=answer.star_count,
        rms_arcsec=answer.rms_arcsec,
        centroids=tuple(
            (star.x_px, star.y_px, star.dn, star.hip) for star in answer.centroids[:MAX_CENTROIDS]
        ),
        widths_px=_widths(answer.centroids[:MAX_CENTROIDS]),
        verdict=judged.verdict,
        middle_ns=_within_64_bits(judged.middle_ns),
    )
    if lit is not None:
        record.light_ns = _within_64_bits(lit.light_ns)
        record.q_lit = _numbers(lit.q)
        record.residual_arcsec = _numbers(judged.residual)
        record.first_frame = lit.first
        record.last_frame = lit.last
    return record


def _widths(stars: tuple[ReportedStar, ...]) -> tuple[float | None, ...]:
    widths_px = tuple(star.width_px for star in stars)
    if any(width_px is not None for width_px in widths_px):
        return widths_px
    return ()


def _numbers(values: FloatArray | None) -> Any:
    return None if values is None else tuple(values.tolist())


def below_step(bench: Bench, shown: Shown) -> int:
    """The number of stars in view of a frame that are too faint for the monitor; 0 without an
    attitude.
    """
    if shown.attitude is None:
        return 0
    return bench.count_faint(shown.attitude.q_icrs_to_cam)


def _within_64_bits(value_ns: int) -> int:
    return min(max(value_ns, -(2**63)), 2**63 - 1)


def frame_records(path: Path, *, tell: bool = True) -> Iterator[FrameRecord]:
    """The frames of a ledger as they were written; none if the file is no ledger. `tell`: a
    missing end is reported. Raises InputError for damage.
    """
    return _records(path, FRAME_TOPIC, tell)


def fault_records(path: Path) -> Iterator[FaultRecord]:
    """The beginnings and ends of faults in a ledger. Raises InputError for damage; does not report
    a missing end.
    """
    return _records(path, FAULT_TOPIC)


def event_records(path: Path) -> Iterator[EventRecord]:
    """The events of a run in its ledger. Raises InputError for damage; does not report a missing
    end.
    """
    return _records(path, EVENT_TOPIC)


def answer_records(path: Path) -> Iterator[AnswerRecord]:
    """The tracker's answers in a ledger; none if the run had none. Raises InputError for damage."""
    return _records(path, ANSWER_TOPIC)


def _records(path: Path, topic: str, tell: bool = False) -> Iterator[Any]:
    for number, data in enumerate(read_messages(path, topic, tell=tell), start=1):
        try:
            record = _DECODERS[topic].decode(data)
        except NOT_JSON as error:
            raise _not_ours(path, f"{number} of {topic}", error) from error
        yield record


def _not_ours(path: Path, which: str, error: Exception) -> InputError:
    return InputError(f"{path}: message {which} is not one of hilstar's ({error})")


def drawable_frames(path: Path, max_rate_rad_s: float = math.inf) -> Iterator[FrameRecord]:
    """The frames of a ledger, for drawing them again. Raises InputError for damage, and for numbers
    that an attitude packet may not have; `max_rate_rad_s` is the largest rate, rad/s.
    """
    for number, record in enumerate(frame_records(path), start=1):
        wrong = wrong_in_frame(record, max_rate_rad_s)
        if wrong:
            raise InputError(f"{path}: message {number} of {FRAME_TOPIC}: {wrong}")
        yield record


def wrong_in_frame(record: FrameRecord, max_rate_rad_s: float = math.inf) -> str:
    """A line of text on a frame's numbers that an attitude packet may not have; "" where the frame
    can be drawn again.
    """
    if record.q is not None:
        sample = checked_sample(record.t_ns, record.q, record.rate)
        refusal = sample if isinstance(sample, Refusal) else rate_refusal(sample, max_rate_rad_s)
        if refusal is not None:
            return refusal.detail
    if math.hypot(*(record.velocity_km_s or ())) > MAX_SPEED_KM_S:
        return f"a velocity over {MAX_SPEED_KM_S:g} km/s"
    if (
        record.place_km is not None
        and not MIN_PLACE_KM < math.hypot(*record.place_km) < MAX_PLACE_KM
    ):
        return f"a place beyond {MIN_PLACE_KM:g} to {MAX_PLACE_KM:g} km"
    return ""


def run_records(path: Path) -> Iterator[RunRecord]:
    """The records of a ledger, in their order. Raises InputError for a file that is no ledger or
    is damaged.
    """
    for block in run_blocks(path, 1):
        yield from block


def run_blocks(path: Path, size: int) -> Iterator[list[RunRecord]]:
    """The records of a ledger, in their order, in lists of `size`; the last may be shorter. Raises
    InputError as `run_records`.
    """
    block: list[RunRecord] = []
    last: Topics = {}
    try:
        for topics, messages in read_chunks(path):
            if topics is not last:
                last = topics
                decode = {
                    k: _DECODERS[topic].decode for k, topic in topics.items() if topic in _DECODERS
                }
            block += [decode[channel](data) for channel, data in messages if channel in decode]
            while len(block) >= size:
                yield _checked(block[:size])
                block = block[size:]
        yield _checked(block)
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error
    except (*NOT_JSON, ArithmeticError) as error:
        raise _first_fault(path, error) from error


def attitudes_of(records: Sequence[Any]) -> FloatArray:
    """The attitudes q_icrs_to_cam (n, 4) of the frames among `records` that have one."""
    q = [record.q for record in records if type(record) is FrameRecord and record.q is not None]
    return np.fromiter(chain.from_iterable(q), np.float64, 4 * len(q)).reshape(-1, 4)


def _checked(records: list[RunRecord]) -> list[RunRecord]:
    # `checked_sample` checks the same norm, one attitude at a time, and takes ten times as long.
    with np.errstate(over="ignore"):
        if (np.abs(np.linalg.norm(attitudes_of(records), axis=1) - 1.0) > NORM_TOLERANCE).any():
            raise ArithmeticError("a quaternion's norm is not 1")
    return records


def _first_fault(path: Path, error: Exception) -> InputError:
    """The refusal that names the first wrong message. `run_blocks` does not number messages: after
    its `error` the file is read again.
    """
    every = (
        (topics[channel], data)
        for topics, messages in read_chunks(path, tell=False)
        for channel, data in messages
    )
    for number, (topic, data) in enumerate(every, start=1):
        which = f"{number}, of {topic}"
        try:
            if topic in _DECODERS:
                record = _DECODERS[topic].decode(data)
            else:
                record = None
        except NOT_JSON as wrong:
            return _not_ours(path, f"{which},", wrong)
        if (
            isinstance(record, FrameRecord)
            and record.q is not None
            and abs(math.hypot(*record.q) - 1.0) > NORM_TOLERANCE
        ):
            return InputError(f"{path}: message {which}: {wrong_in_frame(record)}")
    return _not_ours(path, "", error)


class PacketTally:
    """Counts packets: those accepted, and those refused by reason, in `counts`. After MAX_REASONS
    different reasons further ones are counted as "others".
    """

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    def add(self, record: RunRecord) -> None:
        """Add a recorded packet, or a record that counts packets; other records change nothing."""
        if isinstance(record, PacketForm):
            self.count(
                "accepted" if record.accepted else (record.reason or "format").split(":")[0], 1
            )
        elif isinstance(record, CountRecord) and record.kind == "packet":
            self.count(record.reason, record.count)

    def count(self, reason: str, number: int) -> None:
        """Add `number` packets with a reason, "accepted" for accepted ones."""
        if len(self.counts) < MAX_REASONS or reason in self.counts:
            key = reason[:MAX_REASON_CHARACTERS]
        else:
            key = "others"
        self.counts[key] = self.counts.get(key, 0) + number


def read_head(path: Path) -> dict[str, str]:
    """The head of a ledger (the keys that `Ledger` writes); {} if there is none. Raises InputError
    for damage.
    """
    try:
        return read_metadata(path, RUN_METADATA)
    except OSError as error:
        raise cannot_read(path, error, "give the ledger of a run") from error


def codes_ms_of(head: dict[str, str]) -> tuple[float, float] | None:
    """The time of an average frame by `round` and by `exact`, ms, in a run (see `[render]
    codes_ms`), from its ledger's head; None where it was neither measured nor fixed.
    """
    try:
        return msgspec.json.decode(head.get("codes_ms", "null"), type=tuple[float, float] | None)
    except msgspec.MsgspecError:
        return None


def raw_convention(config: BenchConfig) -> str:
    """The entry of a ledger's head that explains the bytes in `raw`: the convention and the
    mounting by which they were converted to `q`. JSON; null for a source without packets.

    `q` and `rate` in the ledger are hilstar's own already: a reader applies neither again.
    """
    settings = config.attitude
    if settings.source not in PACKET_SOURCES:
        return "null"
    of_body = settings.convention.frame == "body"
    if of_body:
        mounting = config.tracker.q_body_to_cam
    else:
        mounting = None
    meaning = {**msgspec.structs.asdict(settings.convention), "q_body_to_cam": mounting}
    return msgspec.json.encode(meaning).decode()


def config_of(head: dict[str, str]) -> BenchConfig | None:
    """The configuration of a run, from its ledger's head; None if the head has none, or none that
    can be read.
    """
    try:
        return msgspec.convert(
            parse_toml(Path("the ledger's head"), head.get("bench_text", "")), BenchConfig
        )
    except (InputError, msgspec.ValidationError, RecursionError):
        return None
