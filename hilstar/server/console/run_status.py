"""The live status of a run on the terminal: a few lines that stay in place, or a plain line every
ten seconds where stderr is no terminal.

The frame loop only stores its newest frame here; another thread writes the text, so that no
terminal delays a frame.
"""

import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from hilstar.basics.errors import printable
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.console.terminal import erases_lines

if TYPE_CHECKING:
    from rich.table import Table

    from hilstar.server.answers.judge import TrackerFigures
    from hilstar.server.pacer import Shown
    from hilstar.server.record.ledger import LedgerSwitch
    from hilstar.server.run_progress import Running

LIVE_EACH_S = 0.5
PLAIN_EACH_S = 10.0
STANDS_STILL_NS = NS_PER_S  # after this time without a frame the status says so
# The frame loop is alive if its last step is not longer ago than the longer of these.
ALIVE_NS, ALIVE_PERIODS = NS_PER_S, 3.0


@dataclass(frozen=True, slots=True)
class RunSource:
    """The facts of a run that its status shows: the source of its attitudes, the renderer, the
    refresh rate, the number of frames (infinite where it is open), and what is wrong with a screen
    that is used by --force.
    """

    attitudes: str
    renderer: str
    refresh_hz: float
    frames: float = math.inf
    forced: str = ""


class StatusLine(NamedTuple):
    """One line of the status: its label, its text, and whether all is well."""

    label: str
    text: str
    well: bool = True


class RunStatus:
    """The status of a run as text, from its counters and its newest frame."""

    def __init__(
        self,
        source: RunSource,
        ledger: "LedgerSwitch | None" = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._source = source
        self._ledger = ledger
        self._clock_ns = clock_ns
        self._begun_ns = clock_ns()
        self._shown: Shown | None = None
        self._running: Running | None = None
        # when the lines were last made: host time, frames, packets
        self._before = (self._begun_ns, 0, 0)

    def follow(self, running: "Running") -> None:
        """Set the run whose counters are read from now on."""
        self._running = running

    def see(self, shown: "Shown") -> None:
        """Set the newest frame; costs the frame loop one assignment."""
        self._shown = shown

    def begun(self) -> bool:
        """Whether the frame loop has begun: it has shown a frame, or waits for the first."""
        return self._running is not None and self._running.loop.watch.alive_ns > 0

    def alive(self) -> bool:
        """Whether the frame loop is alive: its last step is not longer ago than ALIVE_NS, or
        ALIVE_PERIODS refresh periods where these are longer.
        """
        running = self._running
        limit_ns = max(ALIVE_NS, ALIVE_PERIODS / self._source.refresh_hz * NS_PER_S)
        return running is not None and self._clock_ns() - running.loop.watch.alive_ns < limit_ns

    def line(self) -> str:
        """The status in one short line: a wrong sky, the attitude, frames and packets."""
        shown = self._shown
        running = self._running
        if shown is None or running is None:
            return "no frame yet"
        attitude = _attitude_line(shown)
        tally = running.loop.tally
        packets = running.packets
        tally_text = (
            f"{tally.frames} frames, {tally.missed_frames} missed; {packets.received} packets,"
            f" {packets.refused} refused"
        )
        wrong = "".join(f"{condition.text}; " for condition in running.loop.notices.wrong_sky.now())
        return f"{wrong}attitude {attitude.text}; {tally_text}" + (
            "; shown by --force" if self._source.forced else ""
        )

    def lines(self, now_ns: int) -> list[StatusLine]:
        """The status at the host time `now_ns`; rates are averages since the last call."""
        shown = self._shown
        running = self._running
        if shown is None or running is None:
            return [StatusLine("frames", "none yet"), *self._about()]
        tally = running.loop.tally
        packets = running.packets
        then_ns, frames, received = self._before
        self._before = (now_ns, tally.frames, packets.received)
        seconds = max(now_ns - then_ns, 1) / NS_PER_S
        if math.isinf(self._source.frames):
            total = ""
        else:
            total = f" of {self._source.frames:.0f}"
        text = (
            f"{tally.frames}{total} ({(tally.frames - frames) / seconds:.1f}/s),"
            f" {tally.missed_frames} missed"
        )
        frames_line = StatusLine(
            "frames", f"{text}, {tally.stale_frames} stale", not tally.missed_frames
        )
        still_ns = now_ns - shown.swap_ns
        if still_ns > STANDS_STILL_NS:
            frames_line = StatusLine(
                "frames", f"{frames_line.text}; none for {still_ns / NS_PER_S:.1f} s", False
            )
        refused = ", ".join(
            f"{reason} {count}" for reason, count in packets.refused_by.items() if count
        )
        packets_text = (
            f"{packets.received} received ({(packets.received - received) / seconds:.1f}/s),"
            f" {packets.refused} refused"
        )
        refused = ", ".join(
            [refused] * bool(refused) + [f"{packets.lost} lost"] * bool(packets.lost)
        )
        return [
            *(
                StatusLine("sky", f"WRONG: {condition.text}", False)
                for condition in running.loop.notices.wrong_sky.now()
            ),
            _attitude_line(shown),
            frames_line,
            StatusLine("packets", packets_text + (f" ({refused})" if refused else ""), not refused),
            *([] if running.answers is None else [_tracker_line(running.answers.figures)]),
            *self._about(),
        ]

    def _about(self) -> Iterator[StatusLine]:
        if self._ledger is None:
            ledger = None
        else:
            ledger = self._ledger.current
        if ledger is not None:
            if ledger.failure:
                failed = f"; failed: {ledger.failure}"
            else:
                failed = ""
            text = printable(f"{ledger.path}, {ledger.size_bytes / 1e6:.1f} MB{failed}")
            yield StatusLine("ledger", text, ledger.failure is None)
        if self._source.forced:
            yield StatusLine("forced", printable(self._source.forced), False)
        yield StatusLine("source", self._source.attitudes)
        yield StatusLine("display", f"{self._source.refresh_hz:g} Hz, {self._source.renderer}")


def _attitude_line(shown: "Shown") -> StatusLine:
    attitude = shown.attitude
    if attitude is None:
        return StatusLine(
            "attitude", f"{'none yet' if shown.missing else 'hidden'}: the frames are blank", False
        )
    # Imports NumPy, which takes 0.1 s and is not needed for Tab and --help.
    from hilstar.basics.rotation import to_radec_roll_deg, turn_text

    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(attitude.q_icrs_to_cam)
    text = f"RA {turn_text(ra_deg)}, Dec {dec_deg:.4f}, roll {turn_text(roll_deg)} deg"
    rate = attitude.rate_cam_rad_s
    if rate is not None:
        text += f", {math.degrees(math.hypot(*rate)):.4g} deg/s"
    text += f", {attitude.age_ns / NS_PER_MS:.0f} ms old"
    return StatusLine("attitude", text + (": STALE" if shown.stale else ""), not shown.stale)


def _tracker_line(found: "TrackerFigures") -> StatusLine:
    def three(values: list[float] | None) -> str:
        if values is None:
            return "-"
        return ", ".join(f"{value:.1f}" for value in values)

    if found.latency_ms is None:
        late = "-"
    else:
        late = f"{found.latency_ms:.0f} ms"
    if found.availability is None:
        share = "-"
    else:
        share = f"{100 * found.availability:.1f} %"
    text = (
        f"{three(found.residual_arcsec)} arcsec off, rms {three(found.rms_arcsec)}, {share}"
        f" available, {late} late"
    )
    text += f", {found.mode}" if found.mode else ""
    text += (
        f"; {found.wrong} of {found.answers} answers wrong"
        if found.wrong
        else f"; {found.answers} answers"
    )
    text += f", {found.out_of_order} out of order" if found.out_of_order else ""
    text += f", {found.unjudged} not judged" if found.unjudged else ""
    text += f"; {found.trouble}" if found.trouble else ""
    well = not found.silent and not found.trouble and found.verdict != "wrong"
    return StatusLine("tracker", found.silent or text, well)


@contextmanager
def on_terminal(status: RunStatus) -> Iterator[None]:
    """Show the status on stderr during the `with` block: lines in place on a terminal that can
    erase them, else a line every PLAIN_EACH_S.
    """
    stop = threading.Event()
    live = erases_lines()
    if live:
        import rich.live  # noqa: F401 - takes 0.1 s, which must not delay a frame later
    thread = threading.Thread(
        target=_live if live else _plain, args=(status, stop), name="hilstar-status", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _plain(status: RunStatus, stop: threading.Event) -> None:
    begun_s = time.monotonic()
    while not stop.wait(PLAIN_EACH_S):
        lines_text = "; ".join(
            f"{line.label} {line.text}" for line in status.lines(time.monotonic_ns())
        )
        print(f"hilstar: {time.monotonic() - begun_s:.0f} s: {lines_text}", file=sys.stderr)


def _live(status: RunStatus, stop: threading.Event) -> None:
    from rich.console import Console
    from rich.live import Live

    with (
        Live(console=Console(stderr=True), auto_refresh=False, transient=True) as live,
        _logs_above(),
    ):
        while not stop.is_set():
            live.update(_table(status.lines(time.monotonic_ns())), refresh=True)
            stop.wait(LIVE_EACH_S)


def _table(lines: list[StatusLine]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    for line in lines:
        if line.well:
            mark = Text("ok", style="green")
        else:
            mark = Text("!!", style="bold red")
        table.add_row(
            mark, Text(line.label, style="bold"), Text(line.text, overflow="ellipsis", no_wrap=True)
        )
    return table


@contextmanager
def _logs_above() -> Iterator[None]:
    """Send log messages through the stream by which rich replaces stderr, so that they appear above
    the live lines.
    """
    handlers = [h for h in logging.getLogger().handlers if isinstance(h, logging.StreamHandler)]
    before = [handler.setStream(sys.stderr) for handler in handlers]
    try:
        yield
    finally:
        for handler, stream in zip(handlers, before, strict=True):
            if stream is not None:
                handler.setStream(stream)
