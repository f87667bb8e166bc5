"""What a run publishes for its page, and what it does at an operator's orders: without a process,
a browser or a display.
"""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from hilstar.attitude.clock.sender_clock import ClockSummary
from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.basics.wrong_sky import ENDS, RATES
from hilstar.display.render.aids import GRID
from hilstar.instruments.calibrate.first_light.image_sources import Pattern
from hilstar.server.answers.answer import Answer, ReportedStar
from hilstar.server.answers.judge import Judged, TrackerFigures
from hilstar.server.answers.pairing import Lit
from hilstar.server.bench.bench_file import bench_file_of
from hilstar.server.bench.scenario import FaultSchedule, parse_scenario
from hilstar.server.console import publisher
from hilstar.server.console.listener import ListenAddress, PageListener
from hilstar.server.console.messages import (
    FRAME,
    PICTURE,
    PICTURE_HEAD_BYTES,
    SPRITE,
    NewAnswer,
    Order,
    PictureHead,
    PictureRequest,
    ScpiSetup,
    SharedMemory,
)
from hilstar.server.console.page_process import Listeners
from hilstar.server.console.protocol import (
    AttitudeSource,
    LedgerState,
    ShownClock,
    WrongCondition,
)
from hilstar.server.console.publisher import (
    LEDGER_TROUBLES,
    MAX_CLIPPED,
    FramePublisher,
    OrderHandler,
    PageParts,
    RunDescription,
    SessionPublisher,
    WatchedRun,
    _attitude,
    free_path,
    names_of,
    setup_for,
)
from hilstar.server.operator import GAMMA, OnScreen, SwitchRequests
from hilstar.server.pacer import Shown
from hilstar.server.pointing import POINTING
from hilstar.server.record.ledger import Ledger, LedgerSwitch
from hilstar.server.record.ledger_records import MAX_CENTROIDS
from hilstar.server.run_progress import Running
from hilstar.server.screen.screen import Screen
from tests.support.benches import bench_text
from tests.support.drawn import drawn, stars_at
from tests.support.full_disk import files_of_at_most
from tests.support.model_display import model_screen
from tests.support.queued_answers import unasked_answers
from tests.support.waiting import wait_for

WIDTH, HEIGHT = 6, 4
Q = from_radec_roll_deg(84.057, -1.2, 30.0)
DRAWN = drawn(np.zeros((HEIGHT, WIDTH), np.uint8))
TURNING = Attitude(
    Q, 7_500_000, False, rate_cam_rad_s=np.array([math.pi / 180, 0.0, -math.pi / 360])
)


@pytest.fixture
def memory() -> SharedMemory:
    return SharedMemory.make(2 * WIDTH * HEIGHT)


@pytest.fixture
def running(loop, small_bench) -> Running:
    """A run of which 3 frames were missed, with 9 packets and a tracker."""
    tally = loop.tally
    tally.missed_frames, tally.stale_frames, tally.given_up_frames = 3, 2, 1
    packets = PacketCounts(received=9, lost=4)
    packets.refused_by["crc"] = 2
    clock = ClockSummary("exchange", offset_ms=-5.5, drift_ppm=12.0, uncertainty_ms=0.25)
    answers = unasked_answers(small_bench.config.monitor)
    return Running(loop, packets, lambda: clock, answers)


@pytest.fixture
def feed(memory, running) -> FramePublisher:
    published = FramePublisher(memory)
    published.follow(running)
    return published


def test_an_attitude_is_published_in_degrees_and_milliseconds():
    shown = _attitude(Shown(0, 0, TURNING, DRAWN))
    assert shown is not None
    assert (shown.ra_deg, shown.dec_deg, shown.roll_deg) == pytest.approx((84.057, -1.2, 30.0))
    assert shown.rate_deg_s == pytest.approx([1.0, 0.0, -0.5])
    assert shown.age_ms == 7.5
    assert shown.q == pytest.approx(tuple(Q))
    assert _attitude(Shown(0, 0, None, DRAWN)) is None


def test_each_frame_is_published_with_its_numbers(memory, feed):
    feed.see(
        Shown(
            number=70,
            t_ns=0,
            attitude=TURNING,
            drawn=DRAWN,
            draw_ns=100,
            predicted_swap_ns=250,
            swap_ns=300,
            missed_before=2,
            stale=True,
        )
    )
    found = memory.frames.last()
    assert found is not None
    *numbers, _ = FRAME.unpack(found[1])
    assert numbers == [70, 100, 300, 250, 7_500_000, 2, 0, 3, 2]
    # without a prediction, its swap; without an attitude, no age
    feed.see(Shown(71, 0, None, DRAWN, swap_ns=400, missing=True))
    *numbers, flags = FRAME.unpack(memory.frames.last()[1])
    assert numbers[:5] == [71, 0, 400, 400, 0]
    assert flags == publisher.messages.MISSING | publisher.messages.BLANK


def test_pictures_are_copied_while_somebody_wants_them_and_ten_times_a_second_at_most(memory, feed):
    levels = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    copied = drawn(levels)

    def pictures(from_ms: int, to_ms: int) -> int:
        before = memory.pictures.newest
        for at_ms in range(from_ms, to_ms, 10):
            feed.see(Shown(at_ms, 5, TURNING, copied, swap_ns=at_ms * NS_PER_MS))
        return memory.pictures.newest - before

    assert pictures(0, 1000) == 0
    memory.want = PictureRequest(50 * NS_PER_MS, 3 * NS_PER_S)
    assert pictures(1000, 2000) == 10
    memory.want = PictureRequest(250 * NS_PER_MS, 3 * NS_PER_S)
    assert pictures(2000, 4000) == 4
    data = memory.pictures.last()[1]
    head = PictureHead(*PICTURE.unpack_from(data))
    assert (head.width, head.height, head.item_bytes, head.sprites) == (WIDTH, HEIGHT, 2, 0)
    assert (head.q_w, head.q_x, head.q_y, head.q_z) == pytest.approx(tuple(Q))
    shown = np.frombuffer(data, np.uint16, WIDTH * HEIGHT, PICTURE_HEAD_BYTES)
    assert shown.reshape(HEIGHT, WIDTH).tolist() == levels.tolist()


def test_a_coloured_picture_is_grey_by_its_brightest_channel_and_has_its_stars(memory, feed):
    levels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    levels[1, 2] = (4, 90, 7)
    sprites = stars_at([2.25, 4.5], [1.0, 3.0], [11, 12])
    memory.want = PictureRequest(1, NS_PER_S)
    feed.see(Shown(0, 0, None, drawn(levels, sprites), swap_ns=5))
    data = memory.pictures.last()[1]
    grey = np.frombuffer(data, np.uint8, WIDTH * HEIGHT, PICTURE_HEAD_BYTES)
    assert grey.reshape(HEIGHT, WIDTH)[1, 2] == 90
    assert np.count_nonzero(grey) == 1
    stars = np.frombuffer(data, SPRITE, 2, PICTURE_HEAD_BYTES + WIDTH * HEIGHT)
    assert stars["star"].tolist() == [11, 12]
    assert (stars["x_px"].tolist(), stars["y_px"].tolist()) == ([2.25, 4.5], [1.0, 3.0])


SCENARIO = "".join(f'[[fault]]\nkind = "blank"\nname = "{name}"\n' for name in ("stray", "hot"))


def parts_of(bench, make_ledger=None, **parts) -> PageParts:
    """The parts of a run of a bench, whose scenario has two faults."""
    notices = Notices()
    faults = FaultSchedule(parse_scenario(Path("scenario.toml"), SCENARIO))

    def ledger(path: Path) -> Ledger:
        return Ledger(path, bench, notices)

    known = {"faults": faults} | parts
    return PageParts(bench, notices, LedgerSwitch(), make_ledger or ledger, **known)


@pytest.fixture
def parts(small_bench) -> PageParts:
    return parts_of(small_bench)


@pytest.fixture
def orders(feed, parts, monkeypatch):
    """Carries out orders; a frame loop that never comes is waited for 20 ms."""
    monkeypatch.setattr(publisher, "LOOP_WAITS_S", 0.02)
    requests = SwitchRequests()
    handler = OrderHandler(requests, feed, parts)

    def do(name: str, who: str = "ann\nfrom here", **order):
        answer = handler.do(Order(id=4, name=name, who=who, **order))
        assert answer.id == 4
        return answer.status, answer.line

    return SimpleNamespace(do=do, requests=requests, notices=parts.notices)


def test_a_switch_is_done_once_the_frame_loop_has_turned_it(orders):
    def loop() -> None:
        while not orders.requests:
            pass
        request = orders.requests.popleft()
        assert (request.name, request.on, request.share) == ("patch", True, 0.25)
        request.done = True

    frames = threading.Thread(target=loop)
    frames.start()
    try:
        publisher.LOOP_WAITS_S = 60.0  # as long as a busy machine takes
        assert orders.do("patch", level=0.25) == (200, "patch on")
    finally:
        frames.join()


def test_a_switch_that_no_frame_loop_takes_is_called_off(orders):
    status, line = orders.do("blank", on=False)
    assert (status, "nothing changed" in line) == (504, True)
    (request,) = orders.requests
    assert request.called_off


def test_a_patch_of_another_level_is_refused_and_never_asked_for(orders):
    status, line = orders.do("patch", level=0.3)
    assert (status, line) == (400, "no such patch; write a level of 0.0, 0.25, 0.5, 0.75, 1.0")
    assert not orders.requests


def test_a_mark_is_told_in_one_line_with_who_wrote_it(orders):
    told = []
    orders.notices.listen(lambda notice: told.append((notice.kind, notice.detail, notice.who)))
    assert orders.do("mark", text=" lamp \n on ") == (200, "mark told; no ledger is being written")
    ((kind, detail, who),) = told
    assert (kind, detail) == ("mark", f"mark, by {who}: lamp on")
    assert "\n" not in who
    assert orders.do("mark", text=" \n")[0] == 400
    orders.do("mark", who="w" * 61, text="lamp off")
    assert told[-1] == ("mark", f"mark, by {'w' * 60}: lamp off", "w" * 60)
    # a line of text, and no more of what a stranger sends
    orders.do("mark", who="ann", text="t" * 201)
    assert told[-1] == ("mark", f"mark, by ann: {'t' * 200}", "ann")


def test_a_ledger_is_begun_once_and_ended_with_what_became_of_it(orders, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, line = orders.do("ledger")
    assert status == 200
    path = line.removeprefix("ledger on: ")
    assert path.startswith(f"{tmp_path}/hilstar-20")
    assert orders.do("ledger") == (200, line)  # the same one
    assert orders.do("mark", text="x") == (200, "mark written")
    assert orders.do("ledger", on=False) == (200, f"ledger off: {path} is whole")
    assert orders.do("ledger", on=False) == (200, "ledger off")
    assert orders.notices.counts()["operator"] == 2


def test_a_ledger_that_failed_or_cannot_be_made_is_no_success(
    feed, parts, small_bench, tmp_path, monkeypatch
):
    def failing(path):
        raise InputError(f"{path}: cannot be written")

    monkeypatch.chdir(tmp_path)
    on, off = (Order(id=1, name="ledger", who="ann", on=is_on) for is_on in (True, False))
    handler = OrderHandler(SwitchRequests(), feed, parts)
    assert handler.do(on).status == 200
    with files_of_at_most(parts.ledger.current.size_bytes + 1):
        ended = handler.do(off)
    assert (ended.status, ended.line.endswith("File too large")) == (500, True)
    unmade = OrderHandler(SwitchRequests(), feed, parts_of(small_bench, failing))
    assert unmade.do(on).status == 409


def test_a_fault_is_on_once_two_more_frames_have_been_drawn(orders, feed, parts):
    """The next one may have been in drawing when it was asked for."""

    def draw(frames: int) -> threading.Thread:
        """Frames that are drawn once a fault has been asked for."""

        def see() -> None:
            wait_for(parts.faults.on, poll_s=0.001)
            for number in range(frames):
                feed.see(Shown(number, 0, None, DRAWN))

        drawing = threading.Thread(target=see)
        drawing.start()
        return drawing

    feed.see(Shown(0, 0, None, DRAWN))
    for frames, wanted in ((0, 504), (1, 504), (2, 200)):
        drawing = draw(frames)
        status, line = orders.do("fault", fault="hot")
        drawing.join()
        assert status == wanted
        parts.faults.stop("hot")
    assert line == "fault hot on"
    assert orders.do("fault", fault="hott") == (
        404,
        "no fault of that name; did you mean hot? write one of stray, hot",
    )
    assert orders.do("fault", fault="hot", on=False) == (409, "the fault 'hot' is not on; none is")


def test_a_run_without_faults_has_none_to_start(feed, small_bench):
    handler = OrderHandler(SwitchRequests(), feed, parts_of(small_bench, faults=None))
    assert handler.do(Order(id=1, name="fault", who="ann", fault="hot")).status == 409


def test_a_session_s_failed_step_stays_until_it_begins_anew(memory):
    session = SessionPublisher(memory)
    session.say("focus    failed: no dots were seen")
    session.say("response begins")
    session.say("forced   the monitor is another one")
    assert session.now().failed == [
        "focus failed: no dots were seen",
        "forced the monitor is another one",
    ]
    session.say("focus    begins")
    assert session.now().failed == ["forced the monitor is another one"]


def test_a_session_shows_what_fits_and_takes_marks_alone(memory):
    session, told = SessionPublisher(memory), []
    session.notices.listen(lambda notice: told.append((notice.kind, notice.detail)))
    codes = np.zeros((HEIGHT, WIDTH, 3), np.uint16)
    codes[2, 1] = (300, 20, 900)
    session.show(Pattern("red", codes))
    session.show(Pattern("huge", np.zeros((4000, 4000), np.uint16)))
    assert told == [("pattern", "shows red")]
    assert session.now().frame.number == 1
    data = memory.pictures.last()[1]
    grey = np.frombuffer(data, np.uint16, WIDTH * HEIGHT, PICTURE_HEAD_BYTES)
    assert grey.reshape(HEIGHT, WIDTH)[2, 1] == 900
    assert session.do(Order(id=2, name="mark", who="ann", text="lamp on")).status == 200
    assert told[-1] == ("mark", "mark, by ann: lamp on")
    for name, text in (("mark", " "), ("blank", "")):
        assert session.do(Order(id=3, name=name, who="ann", text=text)).status == 409


def test_a_session_shows_a_picture_that_just_fits_and_none_of_a_byte_more(memory):
    session, told = SessionPublisher(memory), []
    session.notices.listen(lambda notice: told.append(notice.detail))
    room = memory.pictures.slot_bytes - PICTURE_HEAD_BYTES
    session.show(Pattern("over", np.zeros((1, room + 1), np.uint8)))
    assert (told, memory.pictures.newest) == ([], 0)
    session.show(Pattern("just", np.zeros((1, room), np.uint8)))
    assert (told, memory.pictures.newest) == (["shows just"], 1)


def test_a_ledger_s_path_is_its_time_and_a_number_where_that_is_taken(tmp_path):
    now = datetime(2027, 1, 15, 8, 0, 3, 250_000, tzinfo=UTC)
    names = []
    for _ in range(3):
        path = free_path(tmp_path, now)
        path.touch()
        names.append(path.relative_to(tmp_path).name)
    stem = "hilstar-20270115T080003Z"
    assert names == [f"{stem}.mcap", f"{stem}-1.mcap", f"{stem}-2.mcap"]


def test_names_are_those_of_the_brightest_stars_without_a_hip_number(monkeypatch):
    monkeypatch.setattr(publisher, "MAX_NAMES", 3)
    stars = SimpleNamespace(
        hip=np.array([0, 7, 0, 0, 0, 0]),
        v_mag=np.array([5.0, -1.0, 1.0, 4.0, 2.0, 3.0]),
        names=lambda which: ["" if k == 4 else f"star {k}" for k in which],
    )
    assert names_of(stars) == {2: "star 2", 5: "star 5"}


def screen_of(folder: Path, gone: str | None = None, forced: tuple[str, ...] = ()) -> Screen:
    """The small bench's screen on a model display."""
    screen, _ = model_screen(folder, gone=gone)
    screen.forced = list(forced)
    return screen


def test_the_state_of_a_run_has_what_each_of_its_parts_says(feed, running, parts, tmp_path):
    running.loop.watch.alive_ns = 4321
    running.loop.pacer.operator.aids.toggle("grid")
    running.loop.tally.first_swap_ns = 0
    running.answers.figures = TrackerFigures(right=8)
    parts = replace(parts, screen=screen_of(tmp_path, forced=("a", "b")))
    parts.faults.start("stray", "ann")
    run = WatchedRun(feed, parts)
    levels = np.zeros((HEIGHT, WIDTH), np.uint8)
    frame = drawn(levels, stars_at(range(31), range(31)), tuple(range(MAX_CLIPPED + 5)))
    feed.see(Shown(70, 0, TURNING, frame, stale=True, on_screen=OnScreen("grid", "covered")))
    ledger = parts.ledger.begin(lambda: parts.make_ledger(tmp_path / "run.mcap"))
    state, size_bytes = run.now(), ledger.size_bytes
    parts.ledger.end()
    assert (state.alive_ns, state.overlay, state.operator_text) == (4321, GRID, "grid")
    assert state.operator["grid"] and not state.operator["blank"]
    frame = state.frame
    assert (frame.number, frame.stars, frame.stale, frame.blank) == (70, 31, True, False)
    assert frame.clipped == list(range(MAX_CLIPPED)) and not frame.missing
    assert state.attitude is not None and state.attitude.age_ms == 7.5
    assert state.clock == ShownClock(
        offset_ms=-5.5, sigma_ms=0.25, drift_ppm=12.0, synchronised=True, mode="exchange"
    )
    counts = state.counts
    assert (counts.missed, counts.stale, counts.given_up) == (3, 2, 1)
    assert (counts.received, counts.accepted, counts.lost) == (9, 7, 4)
    assert counts.refused == {"crc": 2}
    assert (state.hidden, state.forced, state.faults) == ("covered", "a; b", ["stray"])
    assert (state.display_lost, state.gamma, state.pointing) == ("", "", "")
    assert state.ledger == LedgerState(str(ledger.path), size_bytes) and size_bytes
    assert state.tracker == TrackerFigures(right=8)
    assert (state.wrong_sky, state.wrong_sky_s) == ([], 0.0)


def test_what_is_wrong_with_a_run_stays_in_its_state_while_it_lasts(feed, running, parts, tmp_path):
    running.loop.tally.first_swap_ns = 0
    notices = parts.notices
    run = WatchedRun(feed, replace(parts, screen=screen_of(tmp_path, "the window went away")))
    parts.ledger.begin(lambda: parts.make_ledger(tmp_path / "run.mcap"))
    notices.begin(GAMMA, "the ramp is bent")
    notices.begin(POINTING, "points at Orion")
    notices.begin(RATES, "twice as fast")
    for kind, _ in LEDGER_TROUBLES.items():
        notices.begin(kind, kind)
    state = run.now()
    assert (state.gamma, state.pointing) == ("the ramp is bent", "points at Orion")
    assert state.display_lost == "the window went away"
    assert state.wrong_sky == [WrongCondition(RATES, "twice as fast")]
    assert state.wrong_sky_s >= 0.0
    assert state.ledger is not None
    assert state.ledger.failing.split("; ") == list(LEDGER_TROUBLES.values())
    notices.end(GAMMA, "gamma-straight", "")
    notices.end(RATES, ENDS[RATES], "")
    state = run.now()
    parts.ledger.end()
    assert (state.gamma, state.wrong_sky) == ("", [])


def test_before_a_run_is_followed_its_ledger_alone_is_known(memory, parts, tmp_path):
    parts.ledger.begin(lambda: parts.make_ledger(tmp_path / "run.mcap"))
    state = WatchedRun(FramePublisher(memory), parts).now()
    parts.ledger.end()
    assert state.ledger is not None and state.alive_ns == 0


@pytest.mark.parametrize(("mode", "is_known"), [("none", None), ("one-way", False), ("unix", True)])
def test_a_clock_that_is_not_compared_is_none(feed, running, parts, mode, is_known):
    feed.follow(replace(running, clock=lambda: ClockSummary(mode, 1.0, 2.0, 3.0)))
    clock = WatchedRun(feed, parts).now().clock
    assert (None if clock is None else clock.synchronised) is is_known


def test_an_answer_is_published_with_what_was_lit_and_its_stars(memory, feed, running):
    stars = tuple(ReportedStar(k + 0.126, k, 300.0) for k in range(MAX_CENTROIDS + 3))
    lit = Lit(np.array([0.5, 0.5, 0.5, -0.5]), np.zeros(3), 0, first=7, last=9)
    answers = running.answers
    answers.figures = figures = TrackerFigures(right=3)
    answers.newest = Judged(Answer(0, b"", None, Q, centroids=stars), "right", 0, 0.0, lit)
    answers.heard(answers)
    answers.newest = None
    answers.heard(answers)
    first, second = (
        msgspec.json.decode(data, type=NewAnswer) for _, data in memory.answers.after(0)
    )
    assert first.figures == second.figures == figures
    assert first.q_lit == (0.5, 0.5, 0.5, -0.5) and second.q_lit is None
    assert first.centroids[:2] == [(0.13, 0.0), (1.13, 1.0)]
    assert (len(first.centroids), second.centroids) == (MAX_CENTROIDS, [])


def test_the_settings_of_a_page_are_those_of_its_bench_and_its_listeners(tmp_path):
    changes = {"monitor": {"bits": 10, "refresh_hz": 75.0}, "attitude": {"max_rate_deg_s": 12.0}}
    file = bench_file_of(tmp_path / "my.toml", bench_text(changes))
    told = RunDescription("serve", "udp", "udp://*:5560", "asked", steer_port=99)
    anywhere = ListenAddress("0.0.0.0", 0)
    with (
        PageListener(anywhere, "a-token-of-the-page", ("Sky.Lab",)) as page,
        PageListener(anywhere, "a-token-of-scpi-s-own") as scpi,
    ):
        setup = setup_for(Listeners(page, scpi), True, told, file, 1234)
        alone = setup_for(Listeners(None, scpi), False, told, file, 1)
        assert setup_for(Listeners(page, None), True, told, file, 1).scpi is None
    hello = setup.hello
    of_bench = (hello.bench, hello.bits, hello.white_level, hello.refresh_hz, hello.resolution_px)
    assert of_bench == ("my.toml", 10, 1023, 75.0, (320, 240))
    assert (hello.command, hello.control) == ("hilstar serve", True)
    assert (setup.hosts, setup.names, setup.any_address) == (page.hosts, ["sky.lab"], True)
    assert (setup.port, setup.token) == (page.port, "a-token-of-the-page")
    assert (setup.pace, setup.picture_bytes) == ("asked", 1234)
    assert setup.source == AttitudeSource("udp", "udp://*:5560")
    assert setup.scpi == ScpiSetup("a-token-of-scpi-s-own", "udp", 99, 12.0)
    assert (alone.port, alone.token, alone.any_address) == (0, "", False)
    assert not alone.hello.control
