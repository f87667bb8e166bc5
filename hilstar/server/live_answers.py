"""The tracker in the loop of a run: its answers, taken beside the frame loop, judged, recorded and
told.

The frame loop only leaves each frame here. One thread takes what the reader's process has decoded,
fifty times a second and at most MAX_JUDGED_HZ answers a second. Those beyond that are counted and
recorded without a verdict, as one that judging fails on.
"""

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec

from hilstar.basics.allowance import Allowance
from hilstar.basics.errors import one_line
from hilstar.basics.notices import Notices
from hilstar.basics.process.scheduling import HOST_CLOCK, HostClock
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.answers.answer import Answer, AnswerSource
from hilstar.server.answers.judge import AnswerJudge, AnswerRules, Judged, TrackerFigures, unjudged
from hilstar.server.answers.pairing import LitFrame, LitFrames
from hilstar.server.answers.star_widths import AnswerWidths
from hilstar.server.bench.config import Monitor
from hilstar.server.bench.monitor import scan_of
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger import LedgerSwitch
from hilstar.server.record.ledger_records import answer_record

POLL_S = 0.02
FIGURES_NS = NS_PER_S // 10  # between two sets of figures while nothing comes
PROMPT_NS = NS_PER_S // 13  # and while answers come
MAX_JUDGED_HZ = 100
REST_S = 0.002  # after each, so that Python's lock is free for the frame loop
TOO_MANY = "too many"
SILENT, WRONG = "tracker-silent", "wrong-answer"
UNREAD = "answers-unread"
AGAIN_NS = 3 * NS_PER_S  # after the reader is back, a tracker's answer may take so long


class LiveAnswers:
    """A run's tracker: `figures` are the newest. Readable from any thread.

    `swap_to_light_ns` is the time from a swap to the middle row's light, None without a screen.
    """

    def __init__(
        self,
        monitor: Monitor,
        rules: AnswerRules,
        source: AnswerSource,
        notices: Notices,
        ledger: LedgerSwitch,
        *,
        swap_to_light_ns: int | None = None,
        clock: HostClock = HOST_CLOCK,
    ) -> None:
        self.figures = TrackerFigures()
        self.newest: Judged | None = None
        self.widths = AnswerWidths()
        # called with new figures of a new answer
        self.heard: Callable[[LiveAnswers], None] = lambda answers: None
        # called with each, as it is judged
        self.passed_on: Callable[[Answer, int], None] = lambda answer, middle_ns: None
        self._source = source
        self._notices = notices
        self._ledger = ledger
        self._clock = clock
        self._swap_to_light_ns = swap_to_light_ns
        period_ns = NS_PER_S / monitor.refresh_hz
        hold_s = scan_of(monitor).hold_s
        self._frames = LitFrames(period_ns, hold_s, centred=swap_to_light_ns is None)
        self._judge = AnswerJudge(rules, self._frames)
        self._allowance = Allowance(MAX_JUDGED_HZ, MAX_JUDGED_HZ)
        self._too_many = 0
        self._figures_ns = 0
        self._untold = False
        self._unread, self._unread_ns = "", 0  # the reader's, the newest, and when it lasted still
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hilstar-answers", daemon=True)

    def frame(self, shown: Shown, light_ns: int) -> None:
        """Take a frame whose light leaves at `light_ns` of the sender's clock. Called by the
        frame loop.
        """
        attitude = shown.attitude
        on_screen = shown.on_screen
        is_visible = attitude is not None and not on_screen.operator and not on_screen.hidden
        if self._swap_to_light_ns is None:
            host_ns = shown.moment_ns
        else:
            host_ns = shown.swap_ns + self._swap_to_light_ns
        if attitude is not None and is_visible:
            q = attitude.q_icrs_to_cam
        else:
            q = None
        rate_rad_s = shown.drawn.rate_cam_rad_s
        self._frames.add(LitFrame(shown.number, host_ns, light_ns, q, rate_rad_s, shown.fades))

    @contextmanager
    def running(self) -> Iterator[None]:
        """Take answers while this is open."""
        self._thread.start()
        try:
            yield
        finally:
            self._stop.set()
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(POLL_S):
            self._look()
        self._look()

    def _look(self) -> None:
        for answer in self._source.take():
            if not self._allowance.take(answer.host_ns):
                self._too_many += 1
                self._record(unjudged(answer))
                continue
            try:
                self._take(self._judged(answer))
            except Exception as error:  # whatever it is: the run goes on, and so does this
                self._failed(error)
            self._untold = True
            self._stop.wait(REST_S)
        now_ns = self._clock.now_ns()
        if self._frames.newest is None or now_ns - self._figures_ns < (
            PROMPT_NS if self._untold else FIGURES_NS
        ):
            return
        self._figures_ns = now_ns
        refused = dict(self._source.refusals())
        if self._too_many:
            refused[TOO_MANY] = refused.get(TOO_MANY, 0) + self._too_many
        figures = self._judge.figures(now_ns, refused, self._source.trouble())
        self.figures = self._told(figures, now_ns)
        if self._untold:
            self._untold = False
            self.heard(self)

    def _told(self, figures: TrackerFigures, now_ns: int) -> TrackerFigures:
        """The figures, once it is told who is silent where no answer comes: the tracker, or what
        reads it here.
        """
        reason = self._source.unread
        if reason:
            self._unread = reason
            self._unread_ns = now_ns
        unread = bool(self._unread) and now_ns - self._unread_ns < AGAIN_NS
        if figures.silent and unread:  # the tracker may well answer
            figures = msgspec.structs.replace(figures, silent=f"no answer is read: {self._unread}")
        if figures.silent:
            self._notices.begin(UNREAD if unread else SILENT, figures.silent)
        # A tracker that was silent before nothing was read is not known to answer yet.
        if not figures.silent:
            self._notices.end(SILENT, "tracker-answers", "the tracker answers")
        if not figures.silent or not unread:
            self._notices.end(UNREAD, "answers-read", "the tracker's answers are read again")
        return figures

    def _judged(self, answer: Answer) -> Judged:
        try:
            return self._judge.judge(answer)
        except Exception as error:
            # an answer that cannot be judged is counted and recorded all the same
            self._failed(error)
            return self._judge.pass_over(answer)

    def _failed(self, error: Exception) -> None:
        self._notices.tell(
            "answers-failed",
            one_line(f"an answer failed ({type(error).__name__}: {error}); going on"),
        )

    def _take(self, judged: Judged) -> None:
        self.newest = judged
        self.widths.take(judged.answer)
        self._record(judged)
        if judged.verdict == "wrong":
            self._notices.tell(WRONG, wrong_line(judged))
        if judged.verdict != "unjudged":
            self.passed_on(judged.answer, judged.middle_ns)

    def _record(self, judged: Judged) -> None:
        if self._ledger.on:
            self._ledger.answer(answer_record(judged))


def wrong_line(judged: Judged) -> str:
    """What is said of a wrong answer: how far it is off, and in which frames."""
    assert judged.residual is not None and judged.lit is not None
    off = math.hypot(*judged.residual)
    lit = judged.lit
    unit, scale, digits = ("arcsec", 1.0, 0) if off < 3600 else ("deg", 3600.0, 2)
    parts = ", ".join(
        f"{axis} {part / scale:.{digits}f}"
        for axis, part in zip("xyz", judged.residual, strict=True)
    )
    late_ms = (judged.answer.host_ns - judged.middle_ns) / NS_PER_MS
    frames = f"frames {lit.first} to {lit.last}"
    return (
        f"the tracker's answer is off by {off / scale:.{digits}f} {unit} ({parts}) in {frames},"
        f" {late_ms:.0f} ms ago"
    )
