"""Publishes the frames, pictures and state of a run or a first-light session to its page, and
carries out the orders of operators.
"""

import contextlib
import pickle
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import msgspec
import numpy as np
import numpy.typing as npt

from hilstar.attitude.clock.sender_clock import KNOWN_MODES
from hilstar.basics.errors import HilstarError, did_you_mean, one_line, printable
from hilstar.basics.notices import Notice, Notices
from hilstar.basics.rotation import to_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.version import __version__
from hilstar.optics.sprites import brightest
from hilstar.server.answers.star_widths import FocusState
from hilstar.server.bench.certificate_file import certificate_number
from hilstar.server.bench.frame import Bench, aid_levels_of
from hilstar.server.console import messages, protocol
from hilstar.server.console.listener import PageListener
from hilstar.server.console.overlay import OverlayScene, colour_notes, overlay_of
from hilstar.server.console.page_figures import counts_of
from hilstar.server.console.page_process import Listeners, PageProcess
from hilstar.server.operator import GAMMA, PATCHES, SwitchRequest, SwitchRequests
from hilstar.server.pointing import POINTING
from hilstar.server.record.ledger_records import MAX_CENTROIDS

if TYPE_CHECKING:
    from hilstar.server.bench.bench_file import BenchFile
    from hilstar.server.bench.scenario import FaultSchedule
    from hilstar.server.live_answers import LiveAnswers
    from hilstar.server.pacer import Shown
    from hilstar.server.record.ledger import Ledger, LedgerSwitch
    from hilstar.server.run_progress import Running
    from hilstar.server.screen.screen import Screen
    from hilstar.sky.stars import Stars

MIN_PICTURE_NS = NS_PER_S // 10  # shortest interval between two pictures
MAX_CLIPPED = 300  # clipped stars in the state; a picture has hundreds of stars
# Events of `server.record.ledger` that last while the ledger cannot be written.
LEDGER_TROUBLES = {
    "ledger-failed": "cannot be written",
    "ledger-lost": "a file was deleted, truncated or overwritten",
    "ledger-stalled": "the disk accepts nothing",
    "ledger-thin": "the disk is full: frames are not recorded",
}
LOOP_WAITS_S = 2.0
POLL_S = 0.004
MAX_MARK_CHARACTERS = 200
MAX_WHO_CHARACTERS = 60
MAX_NAMES = 5000  # the brightest stars without a HIP number
CODE_BYTES = 2
FAILED, FORCED = "failed:", "forced"  # in `first-light`'s lines on a failed step, a forced monitor


class FramePublisher:
    """Writes the numbers of every frame, and the pictures of some, into shared memory.

    The frame loop's thread does this in microseconds, without a lock and without a call that waits.
    A picture is copied at most ten times a second, and only while a page requests pictures.
    """

    def __init__(self, memory: messages.SharedMemory) -> None:
        self.shown: Shown | None = None
        self.count = 0  # frames so far
        self.running: Running | None = None
        self._memory = memory
        self._picture_due_ns = 0

    def follow(self, running: "Running") -> None:
        """Set the run whose counters are published."""
        self.running = running
        if running.answers is not None:
            running.answers.heard = self._hear

    def _hear(self, answers: "LiveAnswers") -> None:
        """Publish a new answer of the tracker. Called by the thread that reads the answers."""
        newest = answers.newest
        lit = None if newest is None or newest.lit is None else tuple(newest.lit.q.tolist())
        stars = () if newest is None else newest.answer.centroids[:MAX_CENTROIDS]
        places = [(round(star.x_px, 2), round(star.y_px, 2)) for star in stars]
        self._memory.answers.put(
            msgspec.json.encode(messages.NewAnswer(answers.figures, lit, places))
        )

    def see(self, shown: "Shown") -> None:
        """Publish a frame. Called by the frame loop."""
        self.shown = shown
        self.count += 1
        running = self.running
        attitude = shown.attitude
        if running is None:
            return
        tally = running.loop.tally
        packets = running.packets
        flags = (
            messages.STALE * shown.stale
            | messages.MISSING * shown.missing
            | messages.BLANK * (attitude is None)
            | messages.HAS_AGE * (attitude is not None)
        )
        # The age of an absurd stamp is limited, so that FRAME can hold it.
        self._memory.frames.put(
            messages.FRAME.pack(
                shown.number,
                shown.draw_ns,
                shown.swap_ns,
                shown.predicted_swap_ns or shown.swap_ns,
                0 if attitude is None else max(min(attitude.age_ns, 2**62), -(2**62)),
                shown.missed_before,
                tally.frames,
                tally.missed_frames,
                packets.refused,
                flags,
            )
        )
        want = self._memory.want
        if want.each_ns and self._picture_due_ns <= shown.swap_ns < want.until_ns:
            self._picture_due_ns = shown.swap_ns + max(want.each_ns, MIN_PICTURE_NS)
            # Levels that are larger than the bench's monitor do not fit: the run goes on without
            # the picture.
            with contextlib.suppress(ValueError):
                self._copy(shown)

    def _copy(self, shown: "Shown") -> None:
        drawn = shown.drawn.levels
        sprites = shown.drawn.sprites
        levels = drawn if drawn.ndim == 2 else drawn.max(axis=2)  # the page's picture is grey
        height, width = levels.shape
        places: list[np.ndarray] = []
        if sprites is not None:
            brightest_rows = brightest(sprites.data["electrons_per_s"], messages.MAX_SPRITES)
            places = []
            for part in (sprites.star, sprites.x_px, sprites.y_px):
                places.append(part if brightest_rows is None else part[brightest_rows])
        count = len(places[0]) if places else 0
        if shown.attitude is None:
            q = ()
        else:
            q = shown.attitude.q_icrs_to_cam.tolist()
        head = messages.PictureHead(
            shown.number, shown.swap_ns, shown.t_ns, width, height, levels.itemsize, count, *q
        )
        self._memory.put_picture(head, levels, places)


@dataclass(frozen=True, slots=True)
class PageParts:
    """The parts of a run that its page reads and controls. `make_ledger` begins a ledger at a path,
    `answers` are the tracker's; None for a part that the run does not have.
    """

    bench: Bench
    notices: Notices
    ledger: "LedgerSwitch"
    make_ledger: "Callable[[Path], Ledger]"
    screen: "Screen | None" = None
    faults: "FaultSchedule | None" = None
    answers: "LiveAnswers | None" = None


class WatchedRun:
    """Reads the state of a run from its parts, on another thread than the frame loop's."""

    def __init__(self, feed: FramePublisher, parts: PageParts) -> None:
        self._feed = feed
        self._parts = parts
        self._notices = parts.notices

    def now(self) -> messages.RunState:
        """The current state of the run."""
        running = self._feed.running
        shown = self._feed.shown
        if running is None:
            return messages.RunState(host_ns=time.monotonic_ns(), ledger=self._ledger())
        tally = running.loop.tally
        aids = running.loop.pacer.operator.aids
        screen = self._parts.screen
        faults = self._parts.faults
        newest = protocol.NewestFrame()
        if shown is not None:
            newest = protocol.NewestFrame(
                number=shown.number,
                missing=shown.missing,
                stale=shown.stale,
                blank=shown.attitude is None,
                stars=shown.drawn.star_count,
                clipped=list(shown.drawn.clipped_hip[:MAX_CLIPPED]),
            )
        return messages.RunState(
            host_ns=time.monotonic_ns(),
            alive_ns=running.loop.watch.alive_ns,
            frame=newest,
            attitude=_attitude(shown),
            clock=_clock(running),
            counts=counts_of(tally, running.packets),
            operator=aids.states(),
            operator_text=aids.text,
            overlay=aids.overlay,
            patch_share=aids.patch_share,
            hidden="" if shown is None else shown.on_screen.hidden,
            display_lost="" if screen is None else screen.window.gone or "",
            gamma=self._notices.lasting.get(GAMMA, ""),
            forced="" if screen is None else printable("; ".join(screen.forced)),
            ledger=self._ledger(),
            faults=[] if faults is None else faults.on(),
            pointing=self._notices.lasting.get(POINTING, ""),
            wrong_sky=[
                protocol.WrongCondition(condition.kind, condition.text)
                for condition in self._notices.wrong_sky.now()
            ],
            wrong_sky_s=self._wrong_sky_s(tally.first_swap_ns),
            tracker=None if running.answers is None else running.answers.figures,
            focus=None if running.answers is None else running.answers.widths.state,
        )

    def _wrong_sky_s(self, first_swap_ns: int | None) -> float:
        wrong_sky = self._notices.wrong_sky
        if first_swap_ns is None or not wrong_sky.any:
            return 0.0
        return wrong_sky.total(first_swap_ns, time.monotonic_ns()).seconds

    def _ledger(self) -> protocol.LedgerState | None:
        ledger = self._parts.ledger.current
        if ledger is None:
            return None
        troubles = []
        for kind, trouble_text in LEDGER_TROUBLES.items():
            if kind in self._notices.active:
                troubles.append(trouble_text)
        return protocol.LedgerState(
            printable(str(ledger.path)), ledger.size_bytes, "; ".join(troubles)
        )


def _attitude(shown: "Shown | None") -> protocol.ShownAttitude | None:
    attitude = None if shown is None else shown.attitude
    if attitude is None:
        return None
    w, x, y, z = attitude.q_icrs_to_cam.tolist()
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(attitude.q_icrs_to_cam)
    rate = attitude.rate_cam_rad_s
    return protocol.ShownAttitude(
        q=(w, x, y, z),
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        roll_deg=roll_deg,
        rate_deg_s=None if rate is None else np.degrees(rate).tolist(),
        age_ms=attitude.age_ns / NS_PER_MS,
    )


def _clock(running: "Running") -> protocol.ShownClock | None:
    if running.clock is None:
        clock = None
    else:
        clock = running.clock()
    if clock is None or clock.mode == "none":
        return None
    return protocol.ShownClock(
        offset_ms=clock.offset_ms,
        sigma_ms=clock.uncertainty_ms,
        drift_ppm=clock.drift_ppm,
        synchronised=clock.mode in KNOWN_MODES,
        mode=clock.mode,
    )


Done = tuple[int, str]  # the result of an order: an HTTP status and a line of text


class OrderHandler:
    """Checks an operator's orders, passes them to the frame loop or carries them out itself, and
    records them.

    Each call runs on its own thread, and returns when the frame loop, or the disk, has carried out
    the order.
    """

    def __init__(self, requests: SwitchRequests, feed: FramePublisher, parts: PageParts) -> None:
        self._requests = requests
        self._feed = feed
        self._faults = parts.faults
        self._ledger = parts.ledger
        self._notices = parts.notices
        self._make_ledger = parts.make_ledger
        self._ledger_lock = threading.Lock()

    def do(self, order: messages.Order) -> messages.OrderAnswer:
        """Carry out an order. The answer has an HTTP status and a line with the result or the
        fault.
        """
        who = one_line(order.who)[:MAX_WHO_CHARACTERS]
        doers = {
            "ledger": self._switch_ledger,
            "mark": self._mark,
            "fault": self._fault,
        } | dict.fromkeys(protocol.SWITCHES, self._switch)
        try:
            status, line = doers[order.name](order, who)
        except HilstarError as error:
            status = 409
            line = one_line(str(error))
        # The name of a ledger may contain any characters.
        return messages.OrderAnswer(id=order.id, status=status, line=printable(line))

    def _switch(self, order: messages.Order, who: str) -> Done:
        if order.name == "patch" and order.on and order.level not in PATCHES:
            return 400, f"no such patch; write a level of {', '.join(map(str, PATCHES))}"
        request = SwitchRequest(order.name, order.on, who, order.level)
        self._requests.append(request)
        if self._waits_for(lambda: request.done):
            return 200, request.text
        request.called_off = True
        return 504, f"the frame loop did not take it within {LOOP_WAITS_S:g} s; nothing changed"

    def _waits_for(self, holds: Callable[[], bool]) -> bool:
        end_s = time.monotonic() + LOOP_WAITS_S
        while not holds():
            if time.monotonic() > end_s:
                return False
            time.sleep(POLL_S)
        return True

    def _switch_ledger(self, order: messages.Order, who: str) -> Done:
        with self._ledger_lock:
            if order.on:
                path = free_path(self._ledger_folder(), datetime.now(UTC))
                was_on = self._ledger.on
                ledger = self._ledger.begin(lambda: self._make_ledger(path))
                if not was_on:
                    self._notices.tell("operator", f"ledger on, by {who}: {ledger.path}", who)
                return 200, f"ledger on: {ledger.path}"
            ledger_now = self._ledger.current
            if ledger_now is None:
                return 200, "ledger off"
            self._notices.tell("operator", f"ledger off, by {who}: {ledger_now.path}", who)
            self._ledger.end()
            if ledger_now.failure is not None:
                return 500, f"{ledger_now.path}: {ledger_now.failure}"
            return 200, f"ledger off: {ledger_now.path} is whole"

    def _ledger_folder(self) -> Path:
        """The folder of the newest ledger, else the current working directory."""
        if self._ledger.last is None:
            return Path.cwd()
        return self._ledger.last.path.parent

    def _mark(self, order: messages.Order, who: str) -> Done:
        text = printable(" ".join(order.text.split()))[:MAX_MARK_CHARACTERS]
        if not text:
            return 400, 'a mark needs its text: {"text": "..."}'
        self._notices.tell("mark", f"mark, by {who}: {text}", who)
        return 200, "mark written" if self._ledger.on else "mark told; no ledger is being written"

    def _fault(self, order: messages.Order, who: str) -> Done:
        faults = self._faults
        if faults is None or not faults.names():
            return 409, "this run has no faults to start: give it some with --scenario"
        if order.fault not in faults.names():
            meant = did_you_mean(order.fault, faults.names())
            known = ", ".join(faults.names())
            return 404, f"no fault of that name; {meant}write one of {known}"
        before = self._feed.count
        # The next frame may have been in drawing already: the second one has the fault.
        act = faults.start if order.on else faults.stop
        act(order.fault, who)
        if self._waits_for(lambda: self._feed.count > before + 1):
            return 200, f"fault {order.fault} {'on' if order.on else 'off'}"
        return 504, f"asked for, but no frame was drawn within {LOOP_WAITS_S:g} s"


@dataclass(frozen=True, slots=True)
class RunDescription:
    """The description of a run for its page: command, kind and endpoint of the source of attitudes,
    pace of frames (see `Setup.pace`), and the UDP port to which SCPI sends attitudes (0: none).
    """

    command: str
    kind: str
    endpoint: str
    pace: messages.Pace = "clock"
    steer_port: int = 0


def setup_for(
    listeners: Listeners,
    control: bool,
    description: RunDescription,
    file: "BenchFile",
    picture_bytes: int,
) -> messages.Setup:
    """The settings of the page's process for a bench file. `control`: pages may give orders.
    `picture_bytes` is the size of a picture's levels. A run adds its facts to `hello`.
    """
    monitor = file.config.monitor
    page = listeners.page
    scpi = listeners.scpi
    hello = protocol.Hello(
        version=__version__,
        command=f"hilstar {description.command}",
        bench=printable(file.path.name),
        started_utc=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        resolution_px=monitor.resolution_px,
        white_level=2**monitor.bits - 1,
        bits=monitor.bits,
        refresh_hz=monitor.refresh_hz,
        control=control,
    )
    return messages.Setup(
        hello=hello,
        source=protocol.AttitudeSource(description.kind, printable(description.endpoint)),
        hosts=[] if page is None else page.hosts,
        names=[] if page is None else [name.lower() for name in page.names],
        any_address=page is not None and page.any_address,
        port=0 if page is None else page.port,
        token="" if page is None else page.token,
        picture_bytes=picture_bytes,
        pace=description.pace,
        scpi=(
            None
            if scpi is None
            else messages.ScpiSetup(
                scpi.token,
                description.kind,
                description.steer_port,
                file.config.attitude.max_rate_deg_s,
            )
        ),
    )


def free_path(folder: Path, now: datetime) -> Path:
    """A free path in a folder for a new ledger, named by its time, UTC."""
    for k in range(100):
        path = folder / (f"hilstar-{now:%Y%m%dT%H%M%SZ}" + (f"-{k}" if k else "") + ".mcap")
        if not path.exists():
            return path
    return folder / f"hilstar-{now:%Y%m%dT%H%M%S.%fZ}.mcap"


def names_of(stars: "Stars") -> dict[int, str]:
    """The names of the brightest stars without a HIP number, MAX_NAMES at most, by index."""
    unnamed = np.flatnonzero(stars.hip == 0)
    unnamed = unnamed[np.argsort(stars.v_mag[unnamed], kind="stable")[:MAX_NAMES]]
    names = zip(unnamed.tolist(), stars.names(unnamed), strict=True)
    return {star: name for star, name in names if name}


def scene_of(bench: Bench, aids_in_levels: bool) -> OverlayScene:
    """The scene of a bench, from which the page's process draws its overlay. `aids_in_levels`: the
    levels of pictures contain the operator's aids already.
    """
    stars = bench.shown_stars
    overlay = overlay_of(bench)
    return OverlayScene(
        marks=overlay.marks,
        hip=stars.hip.copy(),
        v_mag=stars.v_mag.astype(np.float32),
        names=names_of(stars),
        sky=overlay.sky(),
        aids=aid_levels_of(bench),
        aids_in_levels=aids_in_levels,
        colours=colour_notes(bench),
    )


@contextmanager
def opened_page(
    listeners: Listeners, control: bool, description: RunDescription, parts: PageParts
) -> Iterator[tuple[FramePublisher, SwitchRequests]]:
    """Serve the page and SCPI of a run during the `with` block; gives the publisher of its frames,
    and the queue of the operators' switch requests.
    """
    width, height = parts.bench.config.monitor.resolution_px
    picture_bytes = width * height * (1 if parts.bench.calibration.response.white < 2**8 else 2)
    memory = messages.SharedMemory.make(picture_bytes)
    feed = FramePublisher(memory)
    requests = SwitchRequests()
    bench = parts.bench
    orders = OrderHandler(requests, feed, parts)
    setup = setup_for(listeners, control, description, bench.file, picture_bytes)
    setup.hello.renderer, setup.hello.white_level = (
        bench.renderer.gl_renderer,
        bench.calibration.response.white,
    )
    setup.hello.certificate = certificate_number(bench.file)
    setup.hello.answers = parts.answers is not None
    setup.hello.faults = [] if parts.faults is None else parts.faults.names()
    if listeners.page is not None:
        setup.scene = pickle.dumps(scene_of(bench, aids_in_levels=parts.screen is None))
    with PageProcess(
        setup, memory, listeners, WatchedRun(feed, parts).now, parts.notices, orders.do
    ):
        yield feed, requests


class _SessionNotices(Notices):
    """The events of a session, which go to the page only: the terminal has their lines already."""

    def tell(self, kind: str, detail: str, who: str = "", since_ns: int | None = None) -> None:
        self._hand_on(Notice.now(kind, " ".join(detail.split()), who))


class ShownPattern(Protocol):
    """A pattern that a session shows on the monitor."""

    @property
    def name(self) -> str:
        """The pattern's name."""

    @property
    def codes(self) -> npt.NDArray[np.uint16]:
        """The codes of the monitor's pixels, (h, w) or (h, w, 3)."""


class SessionPublisher:
    """Publishes a first-light session. The session's thread calls `show` and `say`, the thread of
    PageProcess calls `now`.
    """

    def __init__(self, memory: messages.SharedMemory) -> None:
        self._memory = memory
        self.notices = _SessionNotices()
        self._failed: dict[str, str] = {}
        self._patterns = 0
        self.focus: FocusState | None = None

    def show(self, pattern: ShownPattern) -> None:
        """Publish the pattern that the monitor shows now; a coloured one in grey, by the largest
        code of each pixel.
        """
        if pattern.codes.ndim == 2:
            codes = pattern.codes
        else:
            codes = pattern.codes.max(axis=2)
        height, width = codes.shape
        # A step may have measured a larger monitor than the bench file's: its picture does not fit.
        if messages.PICTURE_HEAD_BYTES + codes.nbytes > self._memory.pictures.slot_bytes:
            return
        self._patterns += 1
        head = messages.PictureHead(
            self._patterns, time.monotonic_ns(), 0, width, height, codes.itemsize, 0
        )
        self._memory.put_picture(head, codes)
        self.notices.tell("pattern", f"shows {pattern.name}")

    def say(self, line: str) -> None:
        """Publish a line of the session on the beginning or the end of a step; a failed step stays
        in the state until it begins anew.
        """
        step, _, step_text = line.partition(" ")
        if step == FORCED or step_text.strip().startswith(FAILED):
            self._failed[step] = f"{step} {step_text.strip()}"
        else:
            self._failed.pop(step, None)
        self.notices.tell("step", line)

    def now(self) -> messages.RunState:
        """The current state of the session."""
        now_ns = time.monotonic_ns()
        failed = list(self._failed.values())
        shown = protocol.NewestFrame(number=self._patterns, missing=False, blank=False)
        return messages.RunState(
            host_ns=now_ns, alive_ns=now_ns, frame=shown, failed=failed, focus=self.focus
        )

    def do(self, order: messages.Order) -> messages.OrderAnswer:
        """Record a mark; a session refuses every other order (409)."""
        if order.name != "mark" or not order.text.strip():
            line = "a session takes marks with a text, and no other order"
            return messages.OrderAnswer(id=order.id, status=409, line=line)
        self.notices.tell("mark", f"mark, by {one_line(order.who)}: {one_line(order.text)}")
        return messages.OrderAnswer(
            id=order.id, status=200, line="mark told; a session has no ledger"
        )


@contextmanager
def session_page(
    listener: PageListener, control: bool, file: "BenchFile", command: str = "first-light"
) -> Iterator[SessionPublisher]:
    """Serve the page of a session (`command`) during the `with` block; gives its publisher."""
    monitor = file.config.monitor
    width, height = monitor.resolution_px
    picture_bytes = width * height * CODE_BYTES
    memory = messages.SharedMemory.make(picture_bytes)
    feed = SessionPublisher(memory)
    listeners = Listeners(listener)
    setup = setup_for(
        listeners,
        control,
        RunDescription(command, "session", "", "session"),
        file,
        picture_bytes,
    )
    setup.hello.session = True
    with PageProcess(setup, memory, listeners, feed.now, feed.notices, feed.do):
        yield feed
