"""Reads the shared memory of a run ten times a second, and prepares what pages get: state, health,
chart points, events and pictures.
"""

import contextlib
import math
import struct
import time
import zlib
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import msgspec
import numpy as np

from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.display.response import Levels
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console import messages, protocol
from hilstar.server.console.overlay import MAX_STARS, OverlayScene
from hilstar.server.console.page_figures import RunCounts

SILENT_NS = 6 * NS_PER_S // 10  # the age of a state that is too old: ten come each second
# The frame loop hangs if its last step is older than the longer of these, in ns and in refresh
# periods.
HUNG_NS = 4 * NS_PER_S // 10
HUNG_PERIODS = 2.5
UNASKED_NS = 2 * NS_PER_S  # in lockstep: a simulator without a request for longer is reported
MANY_MISSED_SHARE = 0.5  # share of the last second's frames
MISSING = "frames are missing"
HEADLINES = {True: "Sky is right", False: "Sky is not right"}
SESSION_HEADLINES = {True: "First light goes on", False: "A step has failed"}
FOCUS_HEADLINES = {True: "The focus is measured", False: "No focus is measured"}
TICK_S = 0.1
PACING_EACH_S = 1.0
MIN_INTERVALS = 10
LEVEL = 1  # zlib's fastest: a night sky is nearly all zeros


def utc_text(unix_s: float) -> str:
    """A Unix time, s, as text in UTC: "2026-11-22T19:00:00.123Z"."""
    return f"{datetime.fromtimestamp(unix_s, UTC):%Y-%m-%dT%H:%M:%S.%f}"[:-3] + "Z"


@dataclass(frozen=True, slots=True)
class RecentFrames:
    """The swap of the newest frame (host time, ns; 0 for none), and the share of missed frames in
    the last second, 0 to 1.
    """

    swap_ns: int = 0
    missed_share: float = 0.0


@dataclass(frozen=True, slots=True)
class SkyJudgement:
    """The judgement whether the sky is right: the reasons if not, [] if it is, and a headline.

    `late`: frames are missed, but what is shown is the right sky.
    """

    reasons: list[str]
    headline: str
    late: bool = False


def judged(
    seen: messages.RunState | None,
    now_ns: int,
    lately: RecentFrames,
    refresh_hz: float,
    pace: messages.Pace,
) -> SkyJudgement:
    """The judgement on a run at host time `now_ns`, from its newest state `seen` (None: none yet)
    and the recent frames. For `pace` see `Setup`.
    """
    found = reasons(seen, now_ns, lately, refresh_hz, pace)
    if pace == "session" and seen is not None and seen.focus is not None:
        return SkyJudgement(found, FOCUS_HEADLINES[not found])
    if pace == "session":
        return SkyJudgement(found, SESSION_HEADLINES[not found])
    late = len(found) == 1 and found[0].startswith(MISSING)
    if late:
        share = f"{lately.missed_share:.0%}".replace("%", " %")
        return SkyJudgement(found, f"{share} of frames missed in the last second", late)
    return SkyJudgement(found, HEADLINES[not found])


def reasons(
    seen: messages.RunState | None,
    now_ns: int,
    lately: RecentFrames,
    refresh_hz: float,
    pace: messages.Pace,
) -> list[str]:
    """The reasons why the sky is not right, as lines of text; [] if it is. The arguments are those
    of `judged`.
    """
    if seen is None:
        return ["the run has not begun"]
    if now_ns - seen.host_ns > SILENT_NS:
        return [f"the run's process has been silent for {_s(now_ns - seen.host_ns)}"]
    if pace == "session":
        return seen.failed
    if seen.display_lost:
        reasons_given = [f"the display is lost: {seen.display_lost}"]
    else:
        reasons_given = []
    limit_ns = max(HUNG_NS, HUNG_PERIODS / refresh_hz * NS_PER_S)
    if not seen.alive_ns:
        reasons_given.append("the run is being prepared")
    elif seen.host_ns - seen.alive_ns > limit_ns:
        reasons_given.append(f"the frame loop has hung for {_s(now_ns - seen.alive_ns)}")
    return [*reasons_given, *_of_attitude(seen, now_ns, lately, pace), *_of_rest(seen, lately)]


def _of_attitude(
    seen: messages.RunState, now_ns: int, lately: RecentFrames, pace: messages.Pace
) -> Iterator[str]:
    if not seen.alive_ns:
        return
    if seen.frame.missing:
        yield "no attitude has come yet"
    elif seen.frame.stale:
        if seen.attitude is None:
            age = ""
        else:
            age = f": {_s(round(seen.attitude.age_ms * NS_PER_MS))} old"
        yield f"the attitude is stale{age}"
    elif pace == "asked" and lately.swap_ns and now_ns - lately.swap_ns > UNASKED_NS:
        yield f"the simulator has asked for no frame for {_s(now_ns - lately.swap_ns)}"


def _of_rest(seen: messages.RunState, lately: RecentFrames) -> Iterator[str]:
    if seen.ledger is not None and seen.ledger.failing:
        yield f"the ledger fails: {seen.ledger.failing}"
    if seen.hidden:
        yield f"the window is {seen.hidden}"
    if seen.gamma:
        yield seen.gamma
    if seen.forced:
        yield f"shown by --force: {seen.forced}"
    if seen.operator_text:
        yield f"changed by the operator: {seen.operator_text}"
    for condition in seen.wrong_sky:
        yield condition.line
    if seen.tracker is not None and seen.tracker.silent:
        yield seen.tracker.silent
    if seen.faults:
        yield f"a fault is on: {', '.join(seen.faults)}"
    if lately.missed_share > MANY_MISSED_SHARE:
        yield f"{MISSING}: {lately.missed_share:.0%} of the last second's"


def _s(time_ns: int) -> str:
    s = time_ns / NS_PER_S
    if s < 60:
        return f"{s:.1f} s"
    if s < 3600:
        return f"{int(s // 60)} min {int(s % 60):02d} s"
    return f"{int(s // 3600)} h {int(s % 3600 // 60):02d} min"


class Health:
    """Whether the sky is right (`ok`), since when that is so (`since_s`, Unix time, s), and the
    newest judgement (`found`).
    """

    def __init__(self, unix_s: float) -> None:
        self.ok = False
        self.since_s = unix_s
        self.found = SkyJudgement([], HEADLINES[False])

    @property
    def reasons(self) -> list[str]:
        """The reasons why the sky is not right; [] if it is."""
        return self.found.reasons

    def update(self, found: SkyJudgement, unix_s: float) -> None:
        """Set the judgement at Unix time `unix_s`, s."""
        right = not found.reasons
        if right != self.ok:
            self.ok = right
            self.since_s = unix_s
        self.found = found


class RunReader:
    """The state of a run as its page's process knows it; `look` updates it.

    `seen` is the newest state, None before the first; `points` and `events` are the recent history
    for a new page; `answer` is the tracker's newest answer.
    """

    def __init__(self, memory: messages.SharedMemory, setup: messages.Setup) -> None:
        self._memory = memory
        self.setup = setup
        self.seen: messages.RunState | None = None
        # If a previous page's process of this run died, its judgement still holds.
        self.health = Health(memory.wrong_since_s or time.time())
        self.points: deque[protocol.ChartPoint] = deque(maxlen=round(protocol.HISTORY_S / TICK_S))
        self.events: deque[protocol.EventLine] = deque(maxlen=protocol.KEPT_EVENTS)
        self._frame_at = self._event_at = self._answer_at = 0
        self.answer: messages.NewAnswer | None = None
        self._answered: list[TrackerFigures] = []  # since the last point
        self._wrong = 0
        self._focus_at = 0
        self._last: messages.FrameNumbers | None = None
        self._intervals_ms: deque[tuple[int, float]] = deque()
        self._received: deque[tuple[int, RunCounts]] = deque()  # over the last second
        self._begun_ns = time.monotonic_ns()
        self.pacing: protocol.Pacing | None = None
        self._pacing_ns = 0

    def look(self) -> list[protocol.EventLine]:
        """Read the shared memory, and return the events since the last call."""
        now_ns = time.monotonic_ns()
        unix_s = time.time()
        newest_state = self._memory.states.last()
        if newest_state is not None:
            # A state that is too long for its slot is cut, and cannot be read: the previous stays.
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):
                self.seen = msgspec.json.decode(newest_state[1], type=messages.RunState)
        self.points.append(self._point(now_ns))
        if now_ns - self._pacing_ns > PACING_EACH_S * NS_PER_S:
            self._pacing_ns, self.pacing = now_ns, self._pacing_now(now_ns)
        lately = RecentFrames(0 if self._last is None else self._last.swap_ns, self._missed_share())
        refresh_hz = self.setup.hello.refresh_hz
        self.health.update(judged(self.seen, now_ns, lately, refresh_hz, self.setup.pace), unix_s)
        self._memory.wrong_since_s = 0.0 if self.health.ok else self.health.since_s
        new = []
        for number, data in self._memory.events.after(self._event_at):
            self._event_at = number
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):
                event = msgspec.json.decode(data, type=messages.RunEvent)
                new.append(protocol.EventLine(utc_text(event.unix_s), event.kind, event.line))
        self.events.extend(new)
        return new

    def new_answer(self) -> TrackerFigures | None:
        """The tracker's statistics if it has answered since the last call, else None."""
        figures = None
        for number, data in self._memory.answers.after(self._answer_at):
            self._answer_at = number
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):
                self.answer = msgspec.json.decode(data, type=messages.NewAnswer)
                figures = self.answer.figures
                self._answered.append(figures)
        return figures

    def _point(self, now_ns: int) -> protocol.ChartPoint:
        """The next point of the charts, from the frames and answers since the previous one."""
        point = protocol.ChartPoint(t_s=round((now_ns - self._begun_ns) / NS_PER_S, 3))
        for number, data in self._memory.frames.after(self._frame_at):
            self._frame_at = number
            self._add(point, messages.FrameNumbers._make(messages.FRAME.unpack(data)))
        for figures in self._answered:
            point.wrong = point.wrong + figures.wrong - self._wrong
            self._wrong = figures.wrong
            if figures.verdict == "right" and figures.residual_arcsec is not None:
                point.x_arcsec, point.y_arcsec, point.z_arcsec = figures.residual_arcsec
        self._answered.clear()
        focus = None if self.seen is None else self.seen.focus
        if focus is not None and focus.number != self._focus_at:
            self._focus_at = focus.number
            point.focus_px = focus.sigma_px
        if self.seen is not None:
            self._received.append((now_ns, self.seen.counts))
            while len(self._received) > 1 and now_ns - self._received[0][0] > NS_PER_S:
                self._received.popleft()
            first_ns, first = self._received[0]
            if now_ns > first_ns:
                point.packets_hz = round(
                    (self.seen.counts.received - first.received) / (now_ns - first_ns) * NS_PER_S, 2
                )
        return point

    def _add(self, point: protocol.ChartPoint, frame: messages.FrameNumbers) -> None:
        """Add a frame to the present point of the charts and to the intervals of the pacing."""
        last = self._last
        self._last = frame
        if frame.flags & messages.HAS_AGE:
            point.take("age_ms", frame.age_ns / NS_PER_MS)
        point.take("frame_ms", (frame.swap_ns - frame.draw_ns) / NS_PER_MS)
        # Frames that the page's process missed in the ring leave no interval and no difference.
        if last is None or frame.frames != last.frames + 1:
            return
        interval_ms = (frame.swap_ns - last.swap_ns) / NS_PER_MS
        point.take("interval_ms", interval_ms)
        point.missed += frame.missed - last.missed
        point.refused += frame.refused - last.refused
        if not frame.missed_before:
            self._intervals_ms.append((frame.swap_ns, interval_ms))

    def _missed_share(self) -> float:
        if len(self._received) < 2:
            return 0.0
        (_, first), (_, last) = self._received[0], self._received[-1]
        shown = last.frames - first.frames
        lost = last.missed - first.missed
        return lost / (shown + lost) if shown + lost else 0.0

    def _pacing_now(self, now_ns: int) -> protocol.Pacing | None:
        while (
            self._intervals_ms and now_ns - self._intervals_ms[0][0] > protocol.HISTORY_S * NS_PER_S
        ):
            self._intervals_ms.popleft()
        if len(self._intervals_ms) < MIN_INTERVALS:
            return None
        intervals_ms = np.array([interval for _, interval in self._intervals_ms])
        p50, p99 = np.percentile(intervals_ms, [50, 99])
        return protocol.Pacing(
            round(float(p50), 3),
            round(float(p99), 3),
            round(float(np.std(intervals_ms, ddof=1)), 4),
        )

    def health_now(self) -> protocol.SkyHealth:
        """The answer of `GET /health`."""
        found = self.health.found
        since = utc_text(self.health.since_s)
        return protocol.SkyHealth(self.health.ok, since, found.reasons, found.headline, found.late)

    def state(self) -> protocol.PageState:
        """The state of the run that pages get; an empty one before the first."""
        if self.seen is None:
            seen = messages.RunState(host_ns=0)
        else:
            seen = self.seen
        same: dict[str, Any] = {}
        for name in protocol.SkyState.__struct_fields__:
            same[name] = getattr(seen, name)
        now = utc_text(time.time())
        health = self.health_now()
        return protocol.PageState(
            utc=now, health=health, source=self.setup.source, pacing=self.pacing, **same
        )


@dataclass(frozen=True, eq=False)
class PackedPicture:
    """A picture ready to be sent: its number in the ring, its binary message, and the JSON of its
    marks without and with the grid.
    """

    number: int
    picture: bytes
    truth: str
    truth_with_grid: str


class PicturePacker:
    """Packs the newest picture for pages, which takes 10 to 30 ms: to be called on another thread
    than the servers'. `scene` is None for a session, which has no marks.
    """

    def __init__(self, memory: messages.SharedMemory, scene: OverlayScene | None) -> None:
        self._memory = memory
        self._scene = scene

    def newest(
        self, after: int, seen: messages.RunState | None, answer: messages.NewAnswer | None = None
    ) -> PackedPicture | None:
        """The newest picture with its marks; None if its number is not above `after`. `seen` is
        the run's newest state, `answer` the tracker's newest answer.
        """
        if self._memory.pictures.newest > after:
            found = self._memory.pictures.last()
        else:
            found = None
        if found is None or found[0] <= after:
            return None
        number, data = found
        head = messages.PictureHead._make(messages.PICTURE.unpack_from(data))
        count = head.width * head.height
        dtype = np.dtype(f"<u{head.item_bytes}")
        levels = Levels(
            np.frombuffer(data, dtype, count, messages.PICTURE_HEAD_BYTES).reshape(
                head.height, head.width
            )
        )
        sprites = np.frombuffer(
            data,
            messages.SPRITE,
            head.sprites,
            messages.PICTURE_HEAD_BYTES + count * head.item_bytes,
        )
        if (
            self._scene is not None
            and seen is not None
            and seen.overlay
            and not self._scene.aids_in_levels
        ):
            levels = self._scene.aids.laid_over(levels, seen.overlay, seen.patch_share)
        # The binary message: a length, a JSON head of that many bytes, and the deflated levels.
        form = protocol.PictureFormat(
            w=head.width, h=head.height, frame=head.frame, dtype=f"u{head.item_bytes}"
        )
        text = msgspec.json.encode(form)
        picture = (
            struct.pack("<I", len(text))
            + text
            + zlib.compress(np.ascontiguousarray(levels).tobytes(), LEVEL)
        )
        truth = protocol.Truth(frame=head.frame, stars=[])
        if self._scene is not None:
            q = np.array([head.q_w, head.q_x, head.q_y, head.q_z])
            stars = stars_of(self._scene, sprites, seen)
            shown = q if np.isfinite(q).all() else None
            truth = self._scene.marks.truth(head.frame, stars, shown, grid=True)
            if answer is not None and answer.q_lit is not None and shown is not None:
                residual = answer.figures.residual_arcsec
                lit = np.array(answer.q_lit)
                marks = self._scene.marks.answer(residual, lit, shown, answer.centroids)
                truth = msgspec.structs.replace(
                    truth, reported_px=marks.field_px, centroids_px=marks.centroids_px
                )
        without_grid = msgspec.structs.replace(truth, grid=msgspec.UNSET)
        return PackedPicture(
            number,
            picture,
            protocol.PageText(truth=without_grid).json(),
            protocol.PageText(truth=truth).json(),
        )


def stars_of(
    scene: OverlayScene, sprites: np.ndarray, seen: messages.RunState | None
) -> list[protocol.StarMark]:
    """The marks of the MAX_STARS brightest stars of a picture, the brightest first, from its
    sprites (records of SPRITE).
    """
    # A moving star has several sprites along its path: its mark is at their mean position.
    stars, which = np.unique(sprites["star"], return_inverse=True)
    count = np.bincount(which, minlength=len(stars))
    x_px, y_px = (
        np.bincount(which, sprites[axis], len(stars)) / np.maximum(count, 1)
        for axis in ("x_px", "y_px")
    )
    if seen is None:
        clipped = set()
    else:
        clipped = set(seen.frame.clipped)
    marks = []
    for k in np.argsort(scene.v_mag[stars], kind="stable")[:MAX_STARS].tolist():
        star = int(stars[k])
        v_mag = float(scene.v_mag[stars[k]])
        hip = int(scene.hip[star])
        label = scene.label(star)
        if math.isfinite(v_mag):
            known_mag = round(v_mag, 2)
        else:
            known_mag = None
        place = (round(float(x_px[k]), 2), round(float(y_px[k]), 2))
        over = int((hip or label) in clipped)
        marks.append(
            protocol.StarMark(*place, known_mag, hip, label, over, scene.colours.get(star, ""))
        )
    return marks
