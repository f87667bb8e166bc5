"""What a run publishes for its page, and what it does at an operator's orders: without a process,
a browser or a display.
"""

from __future__ import annotations

import math
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.clock.timeline import Attitude
from hilstar.attitude.receiver import PacketCounts
from hilstar.basics.errors import InputError
from hilstar.basics.notices import Notices
from hilstar.basics.rotation import from_radec_roll_deg
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.console import publisher
from hilstar.server.console.messages import (
    FRAME,
    PICTURE,
    PICTURE_HEAD_BYTES,
    SPRITE,
    Order,
    PictureHead,
    PictureRequest,
    SharedMemory,
)
from hilstar.server.console.publisher import (
    FramePublisher,
    OrderHandler,
    PageParts,
    SessionPublisher,
    _attitude,
)
from hilstar.server.operator import SwitchRequests
from hilstar.server.pacer import Shown
from hilstar.server.record.ledger import LedgerSwitch
from hilstar.server.summary import RunTally

WIDTH, HEIGHT = 6, 4
Q = from_radec_roll_deg(84.057, -1.2, 30.0)
DRAWN = SimpleNamespace(levels=np.zeros((HEIGHT, WIDTH), np.uint8), sprites=None)
TURNING = Attitude(
    Q, 7_500_000, False, rate_cam_rad_s=np.array([math.pi / 180, 0.0, -math.pi / 360])
)


@pytest.fixture
def memory() -> SharedMemory:
    return SharedMemory.make(2 * WIDTH * HEIGHT)


@pytest.fixture
def feed(memory) -> FramePublisher:
    published = FramePublisher(memory)
    tally = RunTally()
    tally.missed_frames = 3
    counts = PacketCounts(received=9)
    counts.refused_by["crc"] = 2
    loop = SimpleNamespace(tally=tally)
    published.follow(SimpleNamespace(loop=loop, packets=counts, answers=None))
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
    drawn = SimpleNamespace(levels=levels, sprites=None)

    def pictures(from_ms: int, to_ms: int) -> int:
        before = memory.pictures.newest
        for at_ms in range(from_ms, to_ms, 10):
            feed.see(Shown(at_ms, 5, TURNING, drawn, swap_ns=at_ms * NS_PER_MS))
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
    sprites = SimpleNamespace(
        data={"electrons_per_s": np.array([5.0, 6.0])},
        star=np.array([11, 12]),
        x_px=np.array([2.25, 4.5]),
        y_px=np.array([1.0, 3.0]),
    )
    memory.want = PictureRequest(1, NS_PER_S)
    feed.see(Shown(0, 0, None, SimpleNamespace(levels=levels, sprites=sprites), swap_ns=5))
    data = memory.pictures.last()[1]
    grey = np.frombuffer(data, np.uint8, WIDTH * HEIGHT, PICTURE_HEAD_BYTES)
    assert grey.reshape(HEIGHT, WIDTH)[1, 2] == 90
    assert np.count_nonzero(grey) == 1
    stars = np.frombuffer(data, SPRITE, 2, PICTURE_HEAD_BYTES + WIDTH * HEIGHT)
    assert stars["star"].tolist() == [11, 12]
    assert (stars["x_px"].tolist(), stars["y_px"].tolist()) == ([2.25, 4.5], [1.0, 3.0])


class Faults:
    """A scenario's faults by name, and what was asked of them."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, str, str]] = []

    def names(self) -> list[str]:
        return ["stray", "hot"]

    def start(self, name: str, who: str) -> None:
        self.asked.append(("start", name, who))

    def stop(self, name: str, who: str) -> None:
        self.asked.append(("stop", name, who))


class KeptLedger:
    """A ledger at a path, which fails where it is told to."""

    def __init__(self, path, failure=None) -> None:
        self.path, self.failure = path, failure
        self.closed = False

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def parts() -> PageParts:
    return PageParts(None, Notices(), LedgerSwitch(), KeptLedger, faults=Faults())


@pytest.fixture
def orders(feed, parts, monkeypatch):
    """Carries out orders; a frame loop that never comes is waited for 20 ms."""
    monkeypatch.setattr(publisher, "LOOP_WAITS_S", 0.02)
    requests = SwitchRequests()
    handler = OrderHandler(requests, feed, parts)

    def do(name: str, **order):
        answer = handler.do(Order(id=4, name=name, who="ann\nfrom here", **order))
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


def test_a_ledger_that_failed_or_cannot_be_made_is_no_success(feed, tmp_path, monkeypatch):
    def failing(path):
        raise InputError(f"{path}: cannot be written")

    monkeypatch.chdir(tmp_path)
    failed = PageParts(None, Notices(), LedgerSwitch(), lambda path: KeptLedger(path, "disk full"))
    unmade = PageParts(None, Notices(), LedgerSwitch(), failing)
    handlers = [OrderHandler(SwitchRequests(), feed, parts) for parts in (failed, unmade)]
    on, off = (Order(id=1, name="ledger", who="ann", on=is_on) for is_on in (True, False))
    assert handlers[0].do(on).status == 200
    ended = handlers[0].do(off)
    assert (ended.status, ended.line.endswith("disk full")) == (500, True)
    assert handlers[1].do(on).status == 409


def test_a_fault_is_on_once_two_more_frames_have_been_drawn(orders, feed, parts):
    """The next one may have been in drawing when it was asked for."""
    feed.see(Shown(0, 0, None, DRAWN))
    status, line = orders.do("fault", fault="hot")
    assert (status, "no frame was drawn" in line) == (504, True)
    faults = parts.faults

    def draw(frames: int):
        def start(name: str, who: str) -> None:
            faults.asked.append(("start", name, who))
            for number in range(frames):
                feed.see(Shown(number, 0, None, DRAWN))

        return start

    faults.start = draw(1)
    assert orders.do("fault", fault="hot")[0] == 504
    faults.start = draw(2)
    assert orders.do("fault", fault="hot") == (200, "fault hot on")
    assert orders.do("fault", fault="hott") == (
        404,
        "no fault of that name; did you mean hot? write one of stray, hot",
    )
    assert [verb for verb, _, _ in faults.asked] == ["start"] * 3


def test_a_run_without_faults_has_none_to_start(feed):
    parts = PageParts(None, Notices(), LedgerSwitch(), KeptLedger)
    handler = OrderHandler(SwitchRequests(), feed, parts)
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
    session.show(SimpleNamespace(name="red", codes=codes))
    session.show(SimpleNamespace(name="huge", codes=np.zeros((4000, 4000), np.uint16)))
    assert told == [("pattern", "shows red")]
    assert session.now().frame.number == 1
    data = memory.pictures.last()[1]
    grey = np.frombuffer(data, np.uint16, WIDTH * HEIGHT, PICTURE_HEAD_BYTES)
    assert grey.reshape(HEIGHT, WIDTH)[2, 1] == 900
    assert session.do(Order(id=2, name="mark", who="ann", text="lamp on")).status == 200
    assert told[-1] == ("mark", "mark, by ann: lamp on")
    for name, text in (("mark", " "), ("blank", "")):
        assert session.do(Order(id=3, name=name, who="ann", text=text)).status == 409
