"""Open pages: which one gives way to a new one, and what is sent to each and taken from it."""

from __future__ import annotations

import asyncio
import itertools
from types import SimpleNamespace

import pytest
from starlette.websockets import WebSocket, WebSocketState

from hilstar.server.console.protocol import GIVES_WAY, PageWants
from hilstar.server.console.server import connections
from hilstar.server.console.server.connections import (
    LINE,
    MAX_CLIENTS,
    MAX_WAITING_TEXTS,
    MAX_WISHES,
    POLICY,
    TRY_AGAIN,
    OpenPage,
    OpenPages,
)
from tests.support.waiting import PATIENCE_S

ORIGIN = (b"origin", b"http://127.0.0.1:8765")


def page(
    address: str = "10.0.0.9", *, is_read=True, asked=True, by_browser=True, says=(), sent=None
) -> OpenPage:
    """A page from an address, which `says` texts and then nothing further; `sent` gets what it is
    sent.
    """
    texts = iter(says)

    async def receive() -> dict[str, str]:
        for text in texts:
            return {"type": "websocket.receive", "text": text}
        return {"type": "websocket.disconnect"} if says else await asyncio.Event().wait()

    async def send(message) -> None:
        if sent is not None:
            sent.append(message.get("text") or message.get("bytes") or message["code"])

    dropped: list[bool] = []
    line = SimpleNamespace(is_read=is_read, drop=lambda: dropped.append(True), dropped=dropped)
    scope = {"type": "websocket", "client": (address, 1), "extensions": {LINE: line}}
    headers = [ORIGIN] if by_browser else []
    opened = OpenPage(WebSocket(scope | {"headers": headers}, receive, send))
    opened.socket.client_state = WebSocketState.CONNECTED
    opened.socket.application_state = WebSocketState.CONNECTED
    opened.asked = asked
    return opened


def closed_for_another(pages: list[OpenPage]) -> list[int]:
    """The places of those that give way to one more."""

    async def make_room() -> None:
        opened = OpenPages()
        following = [asyncio.create_task(opened.follow(each)) for each in pages]
        await asyncio.sleep(0)
        assert len(opened) == len(pages)
        opened.make_room()
        for task in following:
            task.cancel()
        await asyncio.gather(*following, return_exceptions=True)

    asyncio.run(make_room())
    return [place for place, each in enumerate(pages) if each.closing == GIVES_WAY]


def test_no_page_gives_way_while_there_is_a_place():
    assert closed_for_another([page() for _ in range(MAX_CLIENTS - 1)]) == []


@pytest.mark.parametrize(
    ("odd", "why"),
    [
        ({"is_read": False}, "does not read"),
        ({"asked": False}, "has requested nothing"),
        ({"by_browser": False}, "is no browser's"),
    ],
)
def test_the_page_of_least_use_gives_way(odd, why):
    pages = [page() for _ in range(MAX_CLIENTS)]
    pages[7] = page("10.0.0.1", **odd)
    assert closed_for_another(pages) == [7], why


def test_one_that_does_not_read_gives_way_before_one_that_asked_for_nothing():
    pages = [page() for _ in range(MAX_CLIENTS)]
    pages[3] = page(asked=False)
    pages[8] = page(by_browser=False)
    pages[20] = page(is_read=False)
    assert closed_for_another(pages) == [20]


def test_a_page_that_answers_each_ping_counts_as_one_that_reads_until_the_next():
    """Else it would give way to a new one, in nearly every moment between two pings."""
    assert connections.UNREAD_S >= 2 * connections.PING_S


def test_of_equals_the_oldest_of_the_address_with_the_most_pages_gives_way():
    pages = [page("10.0.0.1"), page("10.0.0.2")]
    pages += [page("10.0.0.3") for _ in range(MAX_CLIENTS - 2)]
    assert closed_for_another(pages) == [2]


def test_a_page_that_does_not_take_ten_seconds_of_states_is_closed():
    for is_read in (True, False):
        slow = page(is_read=is_read)
        for _ in range(MAX_WAITING_TEXTS):
            slow.tell("a state")
        assert slow.closing is None
        slow.tell("one more")
        assert slow.closing == TRY_AGAIN
        # who does not read does not read the close code either
        assert bool(slow.line.dropped) is not is_read


WANTS = '{"want": {"picture": true, "hz": 4.0, "grid": true}}'


def test_what_a_page_wants_is_the_last_that_it_asked_for():
    asking = page(asked=False, says=['{"want": {"hz": 1.0}}', WANTS])
    asyncio.run(asking.listen())
    assert (asking.asked, asking.closing) == (True, None)
    assert (asking.want.picture_hz, asking.want.grid) == (4.0, True)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"want": 3}', "[" * 100_000])
def test_a_page_that_says_what_is_no_wish_is_closed(text):
    wild = page(asked=False, says=[text, WANTS])
    asyncio.run(wild.listen())
    assert (wild.closing, wild.asked) == (POLICY, False)


@pytest.mark.parametrize(("apart_s", "closing"), [(0.04, POLICY), (0.06, None)])
def test_more_wishes_than_a_person_has_close_a_page(monkeypatch, apart_s, closing):
    """40 in two seconds are taken: one in 50 ms."""
    times_s = itertools.count(step=apart_s)
    clock = SimpleNamespace(monotonic=lambda: next(times_s))
    monkeypatch.setattr(connections, "time", clock)
    busy = page(says=[WANTS] * (2 * MAX_WISHES))
    asyncio.run(busy.listen())
    assert busy.closing == closing


def test_pictures_come_at_the_rate_that_a_page_wants_and_the_newest_one(monkeypatch):
    """Of 17 a second a page that wants 4 gets every fourth: a fifth of a period early is in time."""
    now_s = 100.0
    monkeypatch.setattr(connections, "time", SimpleNamespace(monotonic=lambda: now_s))
    wanting, idle = page(says=[WANTS]), page()
    asyncio.run(wanting.listen())
    shown = []
    for number in range(34):
        now_s = 100.0 + number / 17
        picture = SimpleNamespace(picture=number)
        wanting.show(picture)
        idle.show(picture)
        if wanting._packed is picture:
            shown.append(number)
    assert shown == list(range(0, 34, 4))
    assert idle._packed is None


@pytest.mark.parametrize("grid", [False, True])
def test_texts_are_sent_in_order_before_the_newest_picture_with_its_marks(grid):
    sent: list[str | bytes] = []

    async def serve() -> None:
        opened = page(sent=sent)
        opened.want = PageWants(picture=True, grid=grid)
        opened.tell("first")
        opened.tell("second")
        opened.show(SimpleNamespace(truth="bare", truth_with_grid="grid", picture=b"codes"))
        sending = asyncio.create_task(opened.send_all())
        async with asyncio.timeout(PATIENCE_S):
            while len(sent) < 4:
                await asyncio.sleep(0)
        opened.close(GIVES_WAY)
        await sending

    asyncio.run(serve())
    assert sent == ["first", "second", "grid" if grid else "bare", b"codes"]


def test_at_the_end_of_a_run_each_page_gets_the_close_code_of_its_end():
    async def serve(sent: list[list]) -> None:
        opened = OpenPages()
        following = [asyncio.create_task(opened.follow(page(sent=each))) for each in sent]
        await asyncio.sleep(0)
        await opened.close_all(1001)
        for task in following:
            task.cancel()
        await asyncio.gather(*following, return_exceptions=True)
        assert len(opened) == 0

    sent: list[list] = [[], []]
    asyncio.run(serve(sent))
    assert sent == [[1001], [1001]]


def test_a_page_that_gives_way_gets_its_code_once_and_is_told_nothing_more():
    sent: list = []

    async def serve() -> None:
        opened = OpenPages()
        shown = page(sent=sent)
        following = asyncio.create_task(opened.follow(shown))
        await asyncio.sleep(0)
        shown.close(GIVES_WAY)
        shown.tell("too late")
        await following
        assert len(opened) == 0

    asyncio.run(serve())
    assert sent == [GIVES_WAY]


def test_the_rate_of_pictures_is_that_of_the_page_that_wants_most():
    async def serve() -> list[float]:
        opened = OpenPages()
        assert opened.picture_hz == 0.0
        pages = [page() for _ in range(3)]
        for each, hz in zip(pages, (2.0, 5.0, 40.0), strict=True):
            each.want = PageWants(picture=True, hz=hz)
        following = [asyncio.create_task(opened.follow(each)) for each in pages[:2]]
        await asyncio.sleep(0)
        rates_hz = [opened.picture_hz]
        following.append(asyncio.create_task(opened.follow(pages[2])))
        await asyncio.sleep(0)
        rates_hz.append(opened.picture_hz)
        pages[1].want = pages[2].want = PageWants()
        rates_hz.append(opened.picture_hz)
        for task in following:
            task.cancel()
        await asyncio.gather(*following, return_exceptions=True)
        return rates_hz

    assert asyncio.run(serve()) == [5.0, 10.0, 2.0]
