"""What the page's process gets at its start, of a run and of a session: the process is the test's."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from hilstar.basics.notices import Notices
from hilstar.server.bench.build import load
from hilstar.server.console import publisher
from hilstar.server.console.listener import PageListener, parse_address
from hilstar.server.console.page_process import Listeners
from hilstar.server.console.publisher import (
    PageParts,
    RunDescription,
    opened_page,
    session_page,
)
from hilstar.server.record.ledger import LedgerSwitch
from tests.support.benches import bench_text

TOKEN = "0123456789abcdef-0123"


@pytest.fixture
def started(monkeypatch) -> list[tuple[Any, ...]]:
    """What each page's process is started with."""
    made: list[tuple[Any, ...]] = []

    class Process:
        def __init__(self, *given: Any) -> None:
            made.append(given)

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None:
            made.append(("ended",))

    monkeypatch.setattr(publisher, "PageProcess", Process)
    return made


@pytest.fixture
def listeners() -> Iterator[Listeners]:
    """Those of a page and of SCPI at free ports, with a token each."""
    with ExitStack() as stack:
        page, scpi = (
            stack.enter_context(PageListener(parse_address("127.0.0.1:0"), token, names))
            for token, names in ((TOKEN, ("Bench.Lab",)), (TOKEN[::-1], ()))
        )
        yield Listeners(page, scpi)


def bench_of(folder, bits: int = 8):
    """A small bench of a monitor of so many bits."""
    path = folder / "bench.toml"
    path.write_text(bench_text({"monitor": {"bits": bits}, "render": {"quantisation": "round"}}))
    return load(path)


@pytest.mark.parametrize(("bits", "pixel_bytes"), [(8, 1), (10, 2)])
def test_the_page_of_a_run_gets_its_facts_its_scene_and_room_for_its_pictures(
    tmp_path, started, listeners, bits, pixel_bytes
):
    faults = SimpleNamespace(names=lambda: ["dark"])
    described = RunDescription("serve", "scpi", "udp://127.0.0.1:7", "clock", 7)
    with bench_of(tmp_path, bits) as bench:
        parts = PageParts(bench, Notices(), LedgerSwitch(), None, None, faults, object())
        with opened_page(listeners, True, described, parts) as (_, requests):
            setup, _, given, _, notices, _ = started[0]
            assert requests is not None and not requests
        assert (given, notices) == (listeners, parts.notices)
    assert started[-1] == ("ended",)
    assert setup.picture_bytes == 320 * 240 * pixel_bytes
    hello = setup.hello
    assert (hello.command, hello.bench, hello.control) == ("hilstar serve", "bench.toml", True)
    assert (hello.bits, hello.white_level) == (bits, 2**bits - 1)
    assert (hello.renderer, hello.resolution_px) == (bench.renderer.gl_renderer, (320, 240))
    assert (hello.faults, hello.answers, hello.session) == (["dark"], True, False)
    assert (setup.token, setup.port, setup.names) == (TOKEN, listeners.page.port, ["bench.lab"])
    assert (setup.scpi.token, setup.scpi.steer_port) == (TOKEN[::-1], 7)
    scene = pickle.loads(setup.scene)
    # without a screen the aids are in the levels already
    assert scene.aids_in_levels and len(scene.hip) == len(bench.shown_stars)


def test_scpi_alone_needs_no_scene_and_a_run_without_parts_has_none(tmp_path, started, listeners):
    alone = Listeners(None, listeners.scpi)
    with bench_of(tmp_path) as bench:
        parts = PageParts(bench, Notices(), LedgerSwitch(), None)
        with opened_page(alone, False, RunDescription("replay", "log", "a.csv"), parts):
            setup = started[0][0]
    assert setup.scene == b"" and (setup.token, setup.port, setup.hosts) == ("", 0, [])
    assert (setup.hello.faults, setup.hello.answers, setup.hello.control) == ([], False, False)


def test_the_page_of_a_session_says_so_and_has_room_for_codes(tmp_path, started, listeners):
    with bench_of(tmp_path) as bench:
        file = bench.file
    with session_page(listeners.page, True, file, "calibrate focus") as feed:
        setup, _, given, now, notices, do = started[0]
        assert (now, notices, do) == (feed.now, feed.notices, feed.do)
    assert started[-1] == ("ended",) and given == Listeners(listeners.page)
    assert setup.picture_bytes == 2 * 320 * 240
    assert (setup.hello.session, setup.pace) == (True, "session")
    assert (setup.hello.command, setup.source.kind) == ("hilstar calibrate focus", "session")
