"""The servers of a run's page in this process, over loopback: what each address answers and
refuses, what an operator orders, and what a page is told and shown until the run ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import pickle
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import pytest

from hilstar.basics.units import NS_PER_MS
from hilstar.basics.wrong_sky import CONVENTION, ENDS
from hilstar.display.calibration import load_calibration
from hilstar.display.geometry import monitor_camera
from hilstar.display.render.aids import AidLevels
from hilstar.server.console.messages import (
    FRAME,
    HAS_AGE,
    FrameNumbers,
    Order,
    OrderAnswer,
    PictureHead,
    RunEvent,
    RunState,
    ScpiSetup,
    Setup,
    SharedMemory,
)
from hilstar.server.console.overlay import CameraMarks, OverlayScene
from hilstar.server.console.page_figures import RunCounts
from hilstar.server.console.protocol import (
    AttitudeSource,
    Hello,
    LedgerState,
    NewestFrame,
    ShownAttitude,
    SkyMap,
    SkyPlace,
    WrongCondition,
)
from hilstar.server.console.server import __main__ as main
from hilstar.server.console.server import app
from hilstar.server.console.server.__main__ import OrderChannel, run
from tests.support.pages import PageAddress, live, picture_of
from tests.support.waiting import wait_for

WIDTH, HEIGHT = 4, 3
TOKEN = "a-token-of-twenty-letters"
SKY = SkyMap([SkyPlace(279.2347, 38.7837, 0.03, "α Lyr")])
LEVELS = np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH)


def scene() -> bytes:
    """A scene of one star, as the page's process gets it."""
    camera = monitor_camera((WIDTH, HEIGHT), 100.0, 500.0, np.array([1.0, 0.0, 0.0, 0.0]), None)
    aids = AidLevels(load_calibration("gamma2.2", 8).response, 8, (2, 1))
    hip, v_mag = np.array([91262], np.int32), np.array([0.03], np.float32)
    marks = CameraMarks(camera, camera)
    return pickle.dumps(OverlayScene(marks, hip, v_mag, {}, SKY, aids, False, {}))


class ServedPage:
    """A page that is served here: `orders` came from it, and `answer` is given to each."""

    def __init__(self, port: int, token: str, memory: SharedMemory, channel: socket.socket) -> None:
        self.address = PageAddress("127.0.0.1", port, token)
        self.memory = memory
        self._channel = channel
        self.orders: list[Order] = []
        self.answer = (200, "done")
        self.scpi_port = 0

    def state(self, **changes: Any) -> None:
        """The run writes its state."""
        now_ns = time.monotonic_ns()
        frame = NewestFrame(number=7, missing=False, blank=False, stars=31)
        known = {"host_ns": now_ns, "alive_ns": now_ns, "frame": frame}
        self.memory.states.put(msgspec.json.encode(RunState(**(known | changes))))

    def obey(self) -> None:
        """Answer the orders that come over the channel, each by a state after it, until it ends."""
        with contextlib.suppress(OSError):
            while data := self._channel.recv(10_000):
                order = msgspec.json.decode(data, type=Order)
                self.orders.append(order)
                status, line = self.answer
                told = OrderAnswer(id=order.id, status=status, line=line)
                self._channel.send(msgspec.json.encode(told))
                time.sleep(0.001)  # the page's clock has moved on when the state is written
                self.state(host_ns=time.monotonic_ns() + 10**9)


@contextmanager
def served(
    token: str = "", control: bool = True, memory: SharedMemory | None = None
) -> Iterator[ServedPage]:
    """A page of a run and its SCPI, until the run's end."""
    listener, scpi_listener = (socket.create_server(("127.0.0.1", 0)) for _ in range(2))
    port = listener.getsockname()[1]
    memory = SharedMemory.make(WIDTH * HEIGHT) if memory is None else memory
    hello = Hello(
        version="0",
        command="hilstar serve",
        bench="bench.toml",
        renderer="llvmpipe",
        started_utc="",
        resolution_px=(WIDTH, HEIGHT),
        white_level=255,
        bits=8,
        refresh_hz=60.0,
        control=control,
    )
    setup = Setup(
        hello=hello,
        source=AttitudeSource("udp", "udp://127.0.0.1:5560"),
        hosts=["127.0.0.1"],
        names=[],
        any_address=False,
        port=port,
        token=token,
        picture_bytes=WIDTH * HEIGHT,
        pace="clock",
        scene=scene(),
        scpi=ScpiSetup(token="", source="udp"),
    )
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    page = ServedPage(port, token, memory, ours)
    page.scpi_port = scpi_listener.getsockname()[1]
    serving = run(setup, memory, OrderChannel(theirs), listener, scpi_listener)
    threads = [
        threading.Thread(target=asyncio.run, args=(serving,)),
        threading.Thread(target=page.obey),
    ]
    for thread in threads:
        thread.start()
    try:
        yield page
    finally:
        ours.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join()
        for made in (ours, theirs, listener, scpi_listener):
            made.close()


JSON = {"Content-Type": "application/json"}


def test_the_page_and_what_it_needs_are_served_with_the_headers_that_shut_others_out():
    with served() as page:
        status, headers, body = page.address.ask("/")
        assert (status, headers["content-type"].partition(";")[0]) == (200, "text/html")
        assert b"<title>" in body
        assert headers["x-frame-options"] == "DENY" and headers["cache-control"] == "no-store"
        policy = headers["content-security-policy"]
        assert f"connect-src 'self' ws://127.0.0.1:{page.address.port} wss://" in policy
        assert "default-src 'none'" in policy and "server" not in headers
        for name, kind in (("palette.css", "text/css"), ("protocol.js", "text/javascript")):
            status, headers, body = page.address.ask(f"/static/{name}")
            assert (status, headers["content-type"].partition(";")[0]) == (200, kind)
            assert body
        for path in ("/static/index.html", "/static/none.js", "/static/..%2fapp.py"):
            assert page.address.ask(path)[0] == 404
        assert page.address.ask("/nothing")[0] == 404
        assert page.address.ask("/health", "POST")[0] == 405


def test_health_state_and_sky_are_those_of_the_run():
    with served() as page:
        status, _, body = page.address.ask("/health")
        assert (status, json.loads(body)["reasons"]) == (503, ["the run has not begun"])
        page.state()
        wait_for(lambda: page.address.ask("/health")[0] == 200)
        assert page.address.json("/health")["headline"] == "Sky is right"
        told = page.address.json("/state")
        assert told["hello"]["bench"] == "bench.toml"
        assert told["state"]["frame"]["stars"] == 31
        assert told["state"]["source"] == {"kind": "udp", "endpoint": "udp://127.0.0.1:5560"}
        assert page.address.json("/sky")["stars"] == [[279.2347, 38.7837, 0.03, "α Lyr"]]


def metrics(page: ServedPage) -> dict[str, float]:
    """The metrics of a run by their names and labels."""
    _, headers, body = page.address.ask("/metrics")
    assert headers["content-type"].startswith("application/openmetrics-text")
    rows = re.findall(r"^(hilstar_\S+(?:\{.*\})?) (\S+)$", body.decode(), re.MULTILINE)
    return {name.removeprefix("hilstar_"): float(value) for name, value in rows}


def test_metrics_are_the_run_s_counts_and_conditions_in_units_of_openmetrics():
    memory = SharedMemory.make(WIDTH * HEIGHT)
    begun_ns = time.monotonic_ns()
    for k in range(13):
        swap_ns = begun_ns - (13 - k) * 20 * NS_PER_MS
        numbers = FrameNumbers(k, swap_ns, swap_ns, swap_ns, 0, 0, k + 1, 0, 0, HAS_AGE)
        memory.frames.put(FRAME.pack(*numbers))
    with served(memory=memory) as page:
        page.state(
            counts=RunCounts(
                frames=11, missed=2, stale=3, received=17, accepted=12, lost=4,
                refused={"crc": 5, "rate": 1},
            ),
            attitude=ShownAttitude(
                q=(1.0, 0.0, 0.0, 0.0), ra_deg=0.0, dec_deg=0.0, roll_deg=0.0, rate_deg_s=None,
                age_ms=12.5,
            ),
            frame=NewestFrame(number=7, missing=False, stale=True, blank=False, stars=31),
            ledger=LedgerState("run.mcap", 1234, "cannot be written"),
            wrong_sky=[WrongCondition(CONVENTION, "another convention")],
            operator_text="grid",
            display_lost="gone",
        )  # fmt: skip
        wait_for(lambda: metrics(page).get("frames_total") == 11)
        found = metrics(page)
        wanted = {
            "frames_missed_total": 2,
            'packets_refused_total{reason="crc"}': 5,
            'packets_refused_total{reason="rate"}': 1,
            "attitude_age_seconds": 0.0125,
            "healthy": 0,
            "attitude_missing": 0,
            "attitude_stale": 1,
            "display_lost": 1,
            "operator_override": 1,
            "ledger_failing": 1,
            "console_clients": 0,
        }
        assert {name: found.get(name) for name in wanted} == pytest.approx(wanted)
        kinds = {kind: found[f'wrong_sky{{kind="{kind}"}}'] for kind in ENDS}
        assert kinds == {kind: float(kind == CONVENTION) for kind in ENDS}
        assert found["health_since_timestamp_seconds"] == pytest.approx(time.time(), abs=600)
        for quantile in ("0.5", "0.99"):
            name = f'frame_interval_seconds{{quantile="{quantile}"}}'
            assert found[name] == pytest.approx(0.02)
        with live(page.address):
            wait_for(lambda: metrics(page)["console_clients"] == 1)


@pytest.mark.parametrize(
    ("name", "body", "headers", "status", "words"),
    [
        ("nonsense", "{}", JSON, 404, "there are blank, pause"),
        ("blank", "{}", {"Content-Type": "text/plain"}, 415, "send JSON"),
        ("blank", "{", JSON, 400, "not the JSON of a control"),
        ("blank", '{"one": 1}', JSON, 400, "one"),
        ("blank", b"\xff", JSON, 400, "not the JSON of a control"),
        ("blank", b" " * (app.MAX_BODY_BYTES + 1), JSON, 413, "at most 4000 bytes"),
        ("blank", "{}", JSON | {"Origin": "http://evil.example"}, 403, "another site's page"),
        ("blank", "{}", JSON | {"Host": "evil.example"}, 421, "not served under that name"),
    ],
)
def test_what_is_no_control_is_refused_and_never_ordered(name, body, headers, status, words):
    with served() as page:
        told = page.address.ask(f"/control/{name}", "POST", body, headers)
        assert (told[0], page.orders) == (status, [])
        assert words in json.loads(told[2])["error"]
        # whatever it refuses, it says what every answer says
        assert told[1]["x-content-type-options"] == "nosniff"


def test_a_body_of_the_largest_size_is_taken():
    with served() as page:
        body = b'{"text": "' + b"x" * (app.MAX_BODY_BYTES - 12) + b'"}'
        assert len(body) == app.MAX_BODY_BYTES
        assert page.address.ask("/control/mark", "POST", body, JSON)[0] == 200
        assert len(page.orders[0].text) == app.MAX_BODY_BYTES - 12


def test_of_more_orders_than_may_wait_the_last_is_refused_and_none_is_sent():
    async def ordered() -> tuple[OrderAnswer, list[int]]:
        channel, run_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with channel, run_end:
            orders = OrderChannel(channel)
            waiting = [asyncio.create_task(orders.give(order_of("blank"))) for _ in range(8)]
            await asyncio.sleep(0)
            refused = await orders.give(order_of("blank"))
            run_end.setblocking(False)
            numbers = [msgspec.json.decode(run_end.recv(10_000), type=Order).id for _ in range(8)]
            with pytest.raises(BlockingIOError):
                run_end.recv(10_000)
            for task in waiting:
                task.cancel()
            await asyncio.gather(*waiting, return_exceptions=True)
        return refused, numbers

    refused, numbers = asyncio.run(ordered())
    assert (refused.status, numbers) == (503, list(range(1, 9)))


def order_of(name: str) -> Order:
    return Order(id=0, name=name, who="ann")


def test_a_page_without_control_only_shows():
    with served(control=False) as page:
        status, told = page.address.control("blank")
        assert (status, page.orders) == (403, []) and "--control" in told["error"]


def test_an_order_is_the_operator_s_with_each_of_its_values():
    with served() as page:
        page.state()
        body = json.dumps({"on": False, "level": 0.25, "text": "t", "name": "n"})
        headers = JSON | {"X-Operator": "Ada%20L."}
        status, _, told = page.address.ask("/control/patch", "POST", body, headers)
        assert (status, json.loads(told)) == (200, {"line": "done"})
        page.answer = (409, "not now")
        assert page.address.control("ledger") == (409, {"error": "not now"})
        first, second = page.orders
        assert (first.name, first.who, first.on, first.level) == ("patch", "Ada L.", False, 0.25)
        assert (first.text, first.fault) == ("t", "n")
        assert (second.name, second.who, second.on) == ("ledger", "somebody at the page", True)
        assert second.id != first.id


def test_a_token_is_asked_for_but_by_the_page_s_own_files():
    with served(TOKEN) as page:
        for path in ("/", "/static/palette.css"):
            assert page.address.ask(path, headers={"Authorization": ""})[0] == 200
        for path in ("/health", "/metrics", "/state", "/sky"):
            status, headers, _ = page.address.ask(path, headers={"Authorization": "Bearer no"})
            assert (status, headers["www-authenticate"]) == (401, "Bearer"), path
            assert page.address.ask(path)[0] in {200, 503}
        for token, status in ((f"{TOKEN}x", 401), ("", 401)):
            with pytest.raises(ConnectionRefusedError) as refused, live(page.address, token=token):
                pass
            assert refused.value.args == (status,)
        with live(page.address) as link:
            assert "hello" in next(link.messages())


def test_an_open_page_is_told_the_run_from_its_history_on():
    with served() as page:
        page.state()
        page.memory.events.put(msgspec.json.encode(RunEvent(0.5, "stale", "before it opened")))
        wait_for(lambda: page.address.json("/state")["state"]["health"]["ok"])
        with live(page.address) as link:
            messages = link.messages()
            first = next(messages)
            assert first["hello"]["renderer"] == "llvmpipe"
            assert first["state"]["frame"]["number"] == 7 and first["history"]
            told = link.await_message(lambda said: "event" in said)
            assert told["event"]["line"] == "before it opened"
            page.memory.events.put(msgspec.json.encode(RunEvent(1.5, "fresh", "while it is open")))
            told = link.await_message(lambda said: "event" in said)
            assert told["event"] == {
                "utc": "1970-01-01T00:00:01.500Z", "kind": "fresh", "line": "while it is open",
            }  # fmt: skip
            told = link.await_message(lambda said: "state" in said)
            assert told["point"]["t_s"] > first["history"][-1]["t_s"]


def test_a_page_that_wants_pictures_makes_the_run_copy_them_and_gets_them():
    with served() as page:
        assert page.memory.want.each_ns == 0
        with live(page.address) as link:
            link.want(picture=True, hz=8, grid=False)
            wait_for(lambda: page.memory.want.each_ns)
            assert page.memory.want.each_ns == 125_000_000
            assert page.memory.want.until_ns > time.monotonic_ns()
            head = PictureHead(70, 5, 6, WIDTH, HEIGHT, 1, 1)
            page.memory.put_picture(head, LEVELS, (np.array([0]), [1.25], [2.5]))
            said = link.await_message(lambda said: "truth" in said)
            assert said["truth"]["frame"] == 70
            assert said["truth"]["stars"] == [[1.25, 2.5, 0.03, 91262, "α Lyr", 0, ""]]
            form, shown = picture_of(link.await_message(lambda said: isinstance(said, bytes)))
            assert (form["frame"], shown.tolist()) == (70, LEVELS.tolist())
            link.want(picture=False)
            wait_for(lambda: page.memory.want.each_ns == 0)


def test_pages_that_do_not_read_are_closed_and_who_reads_stays(monkeypatch):
    """Pings that nobody answers end a connection after PONG_S."""
    monkeypatch.setattr(main, "PING_S", 0.1)
    monkeypatch.setattr(main, "PONG_S", 0.5)
    with served() as page, contextlib.ExitStack() as stack:
        own = {"Origin": f"http://127.0.0.1:{page.address.port}"}
        for _ in range(4):
            stack.enter_context(live(page.address, own)).want(picture=True, hz=10)
        with live(page.address, own) as link:
            link.await_message(lambda _: metrics(page)["console_clients"] == 5)
            link.await_message(lambda _: metrics(page)["console_clients"] == 1)


def test_scpi_is_served_beside_the_page():
    with served() as page:
        page.state(counts=RunCounts(missed=3))
        wait_for(lambda: page.address.json("/health")["ok"])
        with socket.create_connection(("127.0.0.1", page.scpi_port)) as scpi:
            scpi.sendall(b"FRAM:MISS?\n")
            assert scpi.recv(100) == b"3\n"
            scpi.sendall(b"SKY:BLAN ON;*OPC?\n")
            assert scpi.recv(100) == b"1\n"
            scpi.shutdown(socket.SHUT_WR)
            assert scpi.recv(100) == b""
        assert [(order.name, order.on) for order in page.orders] == [("blank", True)]
