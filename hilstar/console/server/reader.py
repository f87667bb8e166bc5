"""Reads a run's board ten times a second, and words it for the page: the state, the last minute's points, events."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from typing import Any

import msgspec
import numpy as np

from hilstar.console.feed.board import Board
from hilstar.console.feed.messages import HAS_AGE, EventSeen, FrameNumbers, RunSeen, Setup
from hilstar.console.server.health import Health, Lately, reasons
from hilstar.console.server.utc import utc_text
from hilstar.rotation import to_radec_roll_deg
from hilstar.units import NS_PER_MS, NS_PER_S

HISTORY_S = 60
TICK_S = 0.1
KEPT_EVENTS = 200
PACING_EACH_S = 1.0
MIN_INTERVALS = 10


class Reader:
    """The run as a page is told of it. `look` brings it up to date."""

    def __init__(self, board: Board, setup: Setup) -> None:
        self._board, self._setup = board, setup
        self.seen: RunSeen | None = None
        self.health = Health(board.wrong_since_s or time.time())  # an earlier page of this run may have died
        self.points: deque[dict[str, Any]] = deque(maxlen=round(HISTORY_S / TICK_S))
        self.events: deque[dict[str, Any]] = deque(maxlen=KEPT_EVENTS)
        self._frame_at = self._event_at = 0
        self._last: FrameNumbers | None = None
        self._intervals_ms: deque[tuple[int, float]] = deque()
        self._received: deque[tuple[int, int, int, int]] = deque()  # host time, packets, frames, missed
        self._begun_ns = time.monotonic_ns()
        self.pacing: dict[str, float] | None = None
        self._pacing_ns = 0

    def look(self) -> list[dict[str, Any]]:
        """Look at the board; the events that are new."""
        now_ns, unix_s = time.monotonic_ns(), time.time()
        found = self._board.states.last()
        if found is not None:
            with contextlib.suppress(
                msgspec.MsgspecError, UnicodeDecodeError
            ):  # cut, where it was too long: the one before stays
                self.seen = msgspec.json.decode(found[1], type=RunSeen)
        self.points.append(self._point(now_ns))
        if now_ns - self._pacing_ns > PACING_EACH_S * NS_PER_S:
            self._pacing_ns, self.pacing = now_ns, self._pacing_now(now_ns)
        lately = Lately(0 if self._last is None else self._last.swap_ns, self._missed_share())
        self.health.update(reasons(self.seen, now_ns, lately, self._setup.refresh_hz, self._setup.pace), unix_s)
        self._board.wrong_since_s = 0.0 if self.health.ok else self.health.since_s
        return self._new_events()

    def _new_events(self) -> list[dict[str, Any]]:
        new = []
        for number, data in self._board.events.after(self._event_at):
            self._event_at = number
            with contextlib.suppress(msgspec.MsgspecError, UnicodeDecodeError):
                event = msgspec.json.decode(data, type=EventSeen)
                new.append({"utc": utc_text(event.unix_s), "kind": event.kind, "line": event.line})
        self.events.extend(new)
        return new

    def _point(self, now_ns: int) -> dict[str, Any]:
        """What the frames since the last look add to the charts; null where there were none."""
        frames = []
        for number, data in self._board.frames.after(self._frame_at):
            self._frame_at = number
            frames.append(FrameNumbers.unpack(data))
        point: dict[str, Any] = {"t_s": round((now_ns - self._begun_ns) / NS_PER_S, 3), "missed": 0, "refused": 0}
        point |= dict.fromkeys(("age_ms", "interval_ms", "frame_ms"))
        for frame in frames:
            self._add(point, frame)
        point["packets_hz"] = self._rate_hz(now_ns)
        return point

    def _add(self, point: dict[str, Any], frame: FrameNumbers) -> None:
        last, self._last = self._last, frame
        if frame.flags & HAS_AGE:
            _raise(point, "age_ms", frame.age_ns / NS_PER_MS)
        _raise(point, "frame_ms", (frame.swap_ns - frame.draw_ns) / NS_PER_MS)
        if last is None or frame.frames != last.frames + 1:
            return
        interval_ms = (frame.swap_ns - last.swap_ns) / NS_PER_MS
        _raise(point, "interval_ms", interval_ms)
        point["missed"] += frame.missed - last.missed
        point["refused"] += frame.refused - last.refused
        if not frame.missed_before:
            self._intervals_ms.append((frame.swap_ns, interval_ms))

    def _rate_hz(self, now_ns: int) -> float | None:
        seen = self.seen
        if seen is None:
            return None
        self._received.append((now_ns, seen.received, seen.frames, seen.missed))
        while len(self._received) > 1 and now_ns - self._received[0][0] > NS_PER_S:
            self._received.popleft()
        first_ns, first = self._received[0][:2]
        return round((seen.received - first) / (now_ns - first_ns) * NS_PER_S, 2) if now_ns > first_ns else None

    def _missed_share(self) -> float:
        if len(self._received) < 2:
            return 0.0
        (_, _, frames, missed), (_, _, frames_now, missed_now) = self._received[0], self._received[-1]
        shown, lost = frames_now - frames, missed_now - missed
        return lost / (shown + lost) if shown + lost else 0.0

    def _pacing_now(self, now_ns: int) -> dict[str, float] | None:
        while self._intervals_ms and now_ns - self._intervals_ms[0][0] > HISTORY_S * NS_PER_S:
            self._intervals_ms.popleft()
        if len(self._intervals_ms) < MIN_INTERVALS:
            return None
        intervals_ms = np.array([interval for _, interval in self._intervals_ms])
        p50, p99 = np.percentile(intervals_ms, [50, 99])
        return {"p50_ms": round(p50, 3), "p99_ms": round(p99, 3), "sd_ms": round(float(np.std(intervals_ms, ddof=1)), 4)}

    def hello(self) -> dict[str, Any]:
        """What a page is told first."""
        return self._setup.hello | {"history_s": HISTORY_S, "control": self._setup.control}

    def health_now(self) -> dict[str, Any]:
        """The answer of `GET /health`."""
        return {"ok": self.health.ok, "since": utc_text(self.health.since_s), "reasons": self.health.reasons}

    def state(self) -> dict[str, Any]:
        """The state of the run, as the page shows it."""
        seen = RunSeen(host_ns=0) if self.seen is None else self.seen
        ledger, clock = seen.ledger, seen.clock
        return {
            "utc": utc_text(time.time()),
            "health": self.health_now(),
            "attitude": _attitude(seen),
            "source": self._setup.source,
            "clock": None
            if clock is None
            else {
                "offset_ms": clock.offset_ms,
                "sigma_ms": clock.uncertainty_ms,
                "drift_ppm": clock.drift_ppm,
                "synchronised": clock.mode in {"exchange", "shared"},
                "mode": clock.mode,
            },
            "counts": {
                "frames": seen.frames,
                "missed": seen.missed,
                "stale": seen.stale_frames,
                "given_up": seen.given_up,
                "received": seen.received,
                "accepted": seen.received - sum(seen.refused.values()),
                "refused": seen.refused,
            },
            "pacing": self.pacing,
            "frame": {
                "number": seen.frame,
                "missing": seen.missing,
                "stale": seen.stale,
                "blank": seen.blank,
                "stars": seen.stars,
                "clipped": seen.clipped,
            },
            "operator": seen.operator,
            "faults": seen.faults,
            "ledger": None if ledger is None else {"path": ledger.path, "bytes": ledger.bytes, "failing": ledger.failing},
        }


def _raise(point: dict[str, Any], key: str, value: float) -> None:
    before = point[key]
    point[key] = round(value if before is None else max(value, before), 3)


def _attitude(seen: RunSeen) -> dict[str, Any] | None:
    attitude = seen.attitude
    if attitude is None:
        return None
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(np.array(attitude.q))
    rate = attitude.rate_rad_s
    return {
        "q": attitude.q,
        "ra_deg": ra_deg,
        "dec_deg": dec_deg,
        "roll_deg": roll_deg,
        "rate_deg_s": None if rate is None else np.degrees(rate).tolist(),
        "age_ms": attitude.age_ns / NS_PER_MS,
    }
