"""What a ledger holds: a record for each frame, each event, each second of the process, and what was only counted."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from hilstar.attitude.clock.timeline import Attitude
from hilstar.bench.frame import Bench
from hilstar.run.shown import Shown

FRAME_TOPIC, PROCESS_TOPIC, EVENT_TOPIC, COUNT_TOPIC, FAULT_TOPIC = "/frame", "/process", "/event", "/not_kept", "/fault"
# What becomes of the pulse of a frame: a pulse that the line was lost in is "lost", and its frame "skipped" too.
PULSES = ("sent", "skipped", "lost")
HostNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]  # this host's clock, which began at its start
AnyNs = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]  # a sender's clock, or the difference to the host's
Marker = Annotated[int, msgspec.Meta(ge=0, le=1)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]


class FrameRecord(msgspec.Struct, kw_only=True):
    """One frame; times ns: `t_ns` of the timeline, `light_ns` of the sender's clock, the others of this host's.

    `q` is the attitude at `light_ns`, when the middle row lights, and `rate` (rad/s, cam) the turn for which paths were
    drawn, null where stars are points. `velocity_km_s` (ICRS) is that for which stars are aberrated besides the bench file's,
    `place_km` where the source has the observer about the Earth, null where the bench file says it.
    `capped` counts the stars whose paths are coarser than they should be, `missed_before` the refresh periods before it without
    a frame, `missed` those of the run, and `marker` is the photodiode square. `operator`
    says how an operator's keys changed the sky ("blank, grid"; under a blank or a patch `q` is null), `hidden` why the window
    was not seen; "" for neither.
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


_KINDS: dict[Any, str] = {float: "number", str: "string", bool: "boolean"} | dict.fromkeys(
    (int, int | None, HostNs, HostNs | None, AnyNs, AnyNs | None, Count, Marker | None), "integer"
)


def schema_of(record: type[msgspec.Struct], title: str) -> bytes:
    """The JSON schema of a record, of plain types only (see `attitude.logs.mcap_log.ATTITUDE_SCHEMA`)."""
    array = {"type": "array", "items": {"type": "number"}}
    fields = {f.name: {"type": _KINDS[f.type]} if f.type in _KINDS else array for f in msgspec.structs.fields(record)}
    return msgspec.json.encode({"title": title, "type": "object", "properties": fields})


class ProcessRecord(msgspec.Struct, kw_only=True):
    """The process's memory and CPU time at a moment of host time, ns."""

    host_ns: HostNs
    resident_bytes: Count
    cpu_s: float


class EventRecord(msgspec.Struct, kw_only=True):
    """An event of a run (see `hilstar.notices`): host time, ns, its kind, its text, and the person that it comes from."""

    host_ns: HostNs
    kind: str
    detail: str
    who: str = ""


class FaultRecord(msgspec.Struct, kw_only=True):
    """A fault begins or ends ("start", "end"), or fell between two frames ("missed"): at host time, and `t_ns` of the run.

    `number` counts the starts of a run, `who` is "file", "stream" or whoever asked. `table` is the fault as JSON, with the
    keys of a scenario; `seed` that of its randomness, `folder` where its files are, and `file_sha256` that of its map.
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


class CountRecord(msgspec.Struct, kw_only=True):
    """What was only counted, second by second (host time, ns): refused packets by reason, a flood, or pulses.

    `kind` is "packet", "frame", "event" or "pulse"; `reason` that of a refusal, "accepted" of other packets, the kind of an
    event, and of a pulse one of PULSES.
    """

    host_ns: HostNs
    kind: str
    reason: str
    count: Count


class PacketForm(msgspec.Struct):
    """What a report reads of a packet."""

    accepted: bool = True
    reason: str | None = None
    receive_ns: AnyNs | None = None


RunRecord = FrameRecord | ProcessRecord | PacketForm | CountRecord | EventRecord


def frame_record(shown: Shown, light_ns: int, missed: int, below_step: int) -> FrameRecord:
    """The ledger's record of a frame; `light_ns` is on the sender's clock, `missed` counts the run's missed frames
    so far, and `below_step` the stars in view that are too faint for the monitor.
    """
    attitude, drawn = shown.attitude, shown.drawn
    record = FrameRecord(
        frame=shown.number,
        t_ns=shown.t_ns,
        light_ns=light_ns,
        draw_ns=shown.draw_ns,
        predicted_swap_ns=shown.predicted_swap_ns,
        swap_ns=shown.swap_ns,
        timestamp_source=shown.timestamp_source,
        stale=shown.stale,
        stars_drawn=drawn.star_count,
        clipped=len(drawn.clipped_hip),
        below_step=below_step,
        capped=drawn.capped,
        missed_before=shown.missed_before,
        missed=missed,
        marker=shown.marker,
        operator=shown.on_screen.operator,
        hidden=shown.on_screen.hidden,
    )
    if shown.faults:
        record.faults = tuple(one.number for one in shown.faults)
        record.fault_since_ns = tuple(one.since_ns for one in shown.faults)
    if drawn.rate_cam_rad_s is not None:
        x, y, z = drawn.rate_cam_rad_s.tolist()
        record.rate = (x, y, z)
    if attitude is not None:
        _note_attitude(record, attitude, light_ns)
    return record


def _note_attitude(record: FrameRecord, attitude: Attitude, light_ns: int) -> None:
    w, x, y, z = attitude.q_icrs_to_cam.tolist()
    record.q = (w, x, y, z)
    if attitude.velocity_km_s is not None:
        x, y, z = attitude.velocity_km_s.tolist()
        record.velocity_km_s = (x, y, z)
    if attitude.place_km is not None:
        x, y, z = attitude.place_km.tolist()
        record.place_km = (x, y, z)
    record.attitude_sequence = attitude.sequence
    record.attitude_t_ns = _within_64_bits(light_ns - attitude.age_ns)
    record.receive_ns = attitude.received_ns
    record.age_ns = _within_64_bits(attitude.age_ns)
    record.prediction_ns = attitude.prediction_ns


def below_step(bench: Bench, shown: Shown) -> int:
    """How many stars in view of a frame are too faint for the monitor."""
    return 0 if shown.attitude is None else bench.count_faint(shown.attitude.q_icrs_to_cam)


def _within_64_bits(value_ns: int) -> int:
    return min(max(value_ns, -(2**63)), 2**63 - 1)
