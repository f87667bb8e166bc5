"""The summary of a run: the figures of `serve` and `replay`."""

from typing import Any

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import asdict

from hilstar.attitude.clock.sender_clock import ClockSummary
from hilstar.attitude.receiver import PacketCounts
from hilstar.attitude.wire.packet import MESSAGE_REASONS, Reason
from hilstar.basics.running_statistics import Percentiles, RunningStatistics
from hilstar.basics.units import NS_PER_MS
from hilstar.basics.wrong_sky import WrongSkyTotal
from hilstar.display.render.backend import Backend
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.pulse_summary import SyncSummary
from hilstar.server.sync import BeatSummary

MAX_LATE_SHARE = 0.01  # of frames that may be missed or stale where --strict passes


class PacketSummary(msgspec.Struct, frozen=True):
    """Packets of a run, those refused by reason, and how many were lost: gaps of their `sequence`.

    `shown` is what was sent instead, by reason, where its bytes show that.
    """

    received: int
    accepted: int
    refused: int
    refused_by: dict[Reason, int]
    lost: int = 0
    shown: dict[Reason, str] | UnsetType = UNSET


class RunVerdict(msgspec.Struct, frozen=True):
    """Whether a run showed the right sky in time, in one line.

    `late_share` is that of frames missed or stale from the first attitude on, `wrong_sky_s` the
    seconds of a wrong sky. `strict` says whether `--strict` passes.
    """

    ok: bool
    strict: bool
    late_share: float
    wrong_sky_s: float
    line: str


def verdict_of(summary: "RunSummary") -> RunVerdict:
    """The verdict on a run. Frames before the first attitude are blank, and are late in nothing."""
    stale = summary.stale_frames - summary.blank_frames
    due = summary.frames - summary.blank_frames + summary.missed_frames
    if due:
        late_share = (stale + summary.missed_frames) / due
    else:
        late_share = 0.0
    wrong = summary.wrong_sky
    reasons = [] if due else ["no frame had an attitude"]
    if summary.missed_frames:
        reasons.append(
            f"{summary.missed_frames} of {summary.frames + summary.missed_frames} frames missed"
        )
    if stale:
        reasons.append(f"{stale} of {summary.frames} frames with a stale attitude")
    if summary.blank_frames and due:
        reasons.append(
            f"{summary.blank_frames} of {summary.frames} frames before the first attitude"
        )
    if wrong.seconds:
        kinds = ", ".join(condition.kind for condition in wrong.conditions if condition.seconds)
        reasons.append(f"{wrong.seconds:.1f} s of a wrong sky ({kinds})")
    good = not (stale or summary.missed_frames or wrong.seconds) and due > 0
    if good:
        head = f"the sky was right in all {due} frames"
    elif due and not (stale or wrong.seconds):
        head = "the sky was right, but late"
    else:
        head = "the sky was not right throughout"
    line = "; ".join([head, *reasons])
    strict = due > 0 and late_share <= MAX_LATE_SHARE and not wrong.seconds
    return RunVerdict(good, strict, round(late_share, 4), wrong.seconds, line)


class StarSummary(msgspec.Struct, frozen=True):
    """Stars drawn in a frame."""

    mean: float | None
    max: int | None


class ClippedSummary(msgspec.Struct, frozen=True):
    """What is brighter than full scale: how many in a frame at most, and which stars (HIP).

    `bodies` are those that have no HIP number, by name: planets and stars of other catalogues.
    """

    max: int
    hip: list[int]
    bodies: list[str] = []


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The JSON object of `serve` and `replay`; what a kind of run does not have is left unset,
    and is not in its JSON.
    """

    frames: int
    duration_s: float
    fps: float | None
    frame_ms: Percentiles
    attitude_age_ms: Percentiles
    packets: PacketSummary
    stars_drawn: StarSummary
    clipped: ClippedSummary
    missed_frames: int
    stale_frames: int
    capped: int
    given_up: int
    gl_renderer: str
    gl_version: str
    render_path: str
    turn_ms: Percentiles | UnsetType = UNSET
    stale_events: int = 0
    receive_latency_ms: Percentiles | UnsetType = UNSET
    clock: ClockSummary | UnsetType = UNSET
    reconnects: int | UnsetType = UNSET
    events: dict[str, int] = {}
    link: dict[str, str | int] | UnsetType = UNSET
    screen: dict[str, Any] | UnsetType = UNSET
    ledger: dict[str, str | int | None] | UnsetType = UNSET
    faults: dict[str, Any] | UnsetType = UNSET
    answers: TrackerFigures | UnsetType = UNSET
    effort: dict[str, Any] | UnsetType = UNSET
    beat: BeatSummary | UnsetType = UNSET
    sync: SyncSummary | UnsetType = UNSET
    fields_of_view: dict[str, Any] | UnsetType = UNSET
    star: dict[str, Any] | UnsetType = UNSET
    blank_frames: int = 0
    wrong_sky: WrongSkyTotal = WrongSkyTotal()
    verdict: RunVerdict | UnsetType = UNSET


class SwapTally:
    """When frames were swapped onto a screen."""

    def __init__(self) -> None:
        self._interval_ms, self._late_ms, self._packet_ms = (RunningStatistics() for _ in range(3))
        self._last_ns: int | None = None

    def add(
        self, swap_ns: int, predicted_ns: int, missed_before: int, received_ns: int | None
    ) -> None:
        """Add one swap; `received_ns` is when the newest packet behind the frame arrived, None
        if there is none.
        """
        if self._last_ns is not None and not missed_before:
            self._interval_ms.add((swap_ns - self._last_ns) / NS_PER_MS)
        self._last_ns = swap_ns
        self._late_ms.add((swap_ns - predicted_ns) / NS_PER_MS)
        if received_ns is not None:
            self._packet_ms.add((swap_ns - received_ns) / NS_PER_MS)

    def summary(self) -> dict[str, Any]:
        """Jitter of the interval between swaps (standard deviation), lateness and packet to
        swap; {} without a swap.
        """
        if not self._late_ms.count:
            return {}
        return {
            "pacing_jitter_ms": self._interval_ms.deviation,
            "swap_late_ms": asdict(self._late_ms.percentiles()),
            "packet_to_swap_ms": asdict(self._packet_ms.percentiles()),
        }


class RunTally:
    """The figures of all frames of a run."""

    def __init__(self) -> None:
        self._frame_ms, self._age_ms, self._stars = (RunningStatistics() for _ in range(3))
        self.clipped_hip: set[int | str] = set()
        self.swaps = SwapTally()
        self.blank_frames = 0  # before the first attitude
        self.first_swap_ns: int | None = None
        self._clipped_max = self.missed_frames = self.stale_frames = self.capped_frames = (
            self.given_up_frames
        ) = 0

    @property
    def frames(self) -> int:
        """Frames drawn so far."""
        return self._frame_ms.count

    def add(
        self, frame_ns: int, age_ns: int | None, star_count: int, clipped_hip: tuple[int | str, ...]
    ) -> None:
        """Add one frame; `age_ns` is None until an attitude has come."""
        self._frame_ms.add(frame_ns / NS_PER_MS)
        if age_ns is not None:
            self._age_ms.add(age_ns / NS_PER_MS)
        self._stars.add(star_count)
        if clipped_hip:
            self._clipped_max = max(self._clipped_max, len(clipped_hip))
            self.clipped_hip.update(clipped_hip)

    def summary(self, duration_s: float, counts: PacketCounts, renderer: Backend) -> RunSummary:
        """What all kinds of run say; figures without a sample are None."""
        stars = sorted(star for star in self.clipped_hip if isinstance(star, int))
        bodies = sorted(body for body in self.clipped_hip if isinstance(body, str))
        refused_by = {}
        for name, n in counts.refused_by.items():
            if n or name in MESSAGE_REASONS:
                refused_by[name] = n
        return RunSummary(
            frames=self.frames,
            duration_s=duration_s,
            fps=self.frames / duration_s if duration_s > 0 else None,
            frame_ms=self._frame_ms.percentiles(),
            attitude_age_ms=self._age_ms.percentiles(),
            packets=PacketSummary(
                counts.received,
                counts.received - counts.refused,
                counts.refused,
                refused_by,
                counts.lost,
                counts.shown or UNSET,
            ),
            stars_drawn=StarSummary(
                self._stars.mean, int(self._stars.max) if self.frames else None
            ),
            clipped=ClippedSummary(self._clipped_max, stars, bodies),
            missed_frames=self.missed_frames,
            stale_frames=self.stale_frames,
            capped=self.capped_frames,
            given_up=self.given_up_frames,
            blank_frames=self.blank_frames,
            gl_renderer=renderer.gl_renderer,
            gl_version=renderer.gl_version,
            render_path=renderer.path,
        )
