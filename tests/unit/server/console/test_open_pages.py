"""Which open page gives way to a new one where all places are taken."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace

import pytest
from starlette.websockets import WebSocket

from hilstar.server.console.protocol import GIVES_WAY
from hilstar.server.console.server.connections import LINE, MAX_CLIENTS, OpenPage, OpenPages

ORIGIN = (b"origin", b"http://127.0.0.1:8765")


def page(address: str = "10.0.0.9", *, is_read=True, asked=True, by_browser=True) -> OpenPage:
    """A page that says nothing further, from an address."""

    async def nothing() -> dict[str, str]:
        await asyncio.Event().wait()
        return {}

    async def send(message) -> None:
        """Taken."""

    line = SimpleNamespace(is_read=is_read, drop=lambda: None)
    scope = {"type": "websocket", "client": (address, 1), "extensions": {LINE: line}}
    headers = [ORIGIN] if by_browser else []
    opened = OpenPage(WebSocket(scope | {"headers": headers}, nothing, send))
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


def test_of_equals_the_oldest_of_the_address_with_the_most_pages_gives_way():
    pages = [page("10.0.0.1"), page("10.0.0.2")]
    pages += [page("10.0.0.3") for _ in range(MAX_CLIENTS - 2)]
    assert closed_for_another(pages) == [2]
