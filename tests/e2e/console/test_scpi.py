"""SCPI of a run over real sockets, by PyVISA-py as a test stand has it; and by whoever sends it
anything else.
"""

from __future__ import annotations

import contextlib
import re
import resource
import select
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import pyvisa

from hilstar.basics.rotation import conjugate, multiply
from tests.support.benches import LIVE_BENCH, ORION_Q
from tests.support.commands import run_hilstar_here
from tests.support.forks import HILSTAR
from tests.support.pages import children, page_of
from tests.support.servers import Run, Served
from tests.support.waiting import PATIENCE_S, CoreWaits, wait_for

pytestmark = pytest.mark.e2e
ADDRESS = re.compile(r'SCPI is at (\S+):(\d+)(?:, SYST:AUTH "(\S+)" first)?')
STEERED = '[attitude]\nsource = "scpi"\n'
DARK = '[[fault]]\nname = "dark"\nkind = "blank"\n'
NOT_A_NUMBER = 9.91e37
F32 = 1e-6  # of a rate, deg/s: the packet has it in single precision
RSS_MB = 3.0  # what the fuzzed process may grow by: pages of its heap that the first lines use
FUZZ_BYTES = 400_000
PEERS, ASKED = 24, 15
HEALTH_S = 0.1  # the issue's; a median, for the tests beside this one may take a core for as long


@contextlib.contextmanager
def scpi_run(
    folder: Path, attitude: str, *options: str, at: str = "127.0.0.1:0"
) -> Iterator[tuple[Served, re.Match[str]]]:
    """`hilstar serve --scpi`, once it listens, and the line that says where."""
    (folder / "bench.toml").write_text(LIVE_BENCH + attitude)
    (folder / "dark.toml").write_text(DARK)
    command = [*HILSTAR, "serve", str(folder / "bench.toml"), "--headless", "--json", "--scpi", at]
    with Run([*command, "--scenario", str(folder / "dark.toml"), *options]) as process:
        served = Served(process, 0)
        try:
            served.await_line("SCPI is at")
            yield served, next(found for line in served.lines if (found := ADDRESS.search(line)))
        finally:
            process.kill()


class Instrument:
    """A test stand's session."""

    def __init__(self, port: int) -> None:
        self._manager = pyvisa.ResourceManager("@py")
        self._resource = self._manager.open_resource(
            f"TCPIP::127.0.0.1::{port}::SOCKET",
            read_termination="\n",
            write_termination="\r\n",
            open_timeout=1000 * PATIENCE_S,
        )
        self._resource.timeout = 1000 * PATIENCE_S
        self.write, self.ask = self._resource.write, self._resource.query

    def numbers(self, query: str) -> np.ndarray:
        return np.array(self._resource.query_ascii_values(query))

    def errors(self) -> list[int]:
        found = []
        while number := int(self.ask("SYST:ERR?").partition(",")[0]):
            found.append(number)
        return found

    def close(self) -> None:
        self._resource.close()
        self._manager.close()


@contextlib.contextmanager
def instrument(port: int) -> Iterator[Instrument]:
    with contextlib.closing(Instrument(port)) as opened:
        yield opened


@pytest.fixture(scope="module")
def scpi_steered_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scpi")
    with scpi_run(folder, STEERED, "--ledger", str(folder / "run.mcap")) as (served, found):
        yield served, int(found[2])


@pytest.fixture
def stand(scpi_steered_run):
    with instrument(scpi_steered_run[1]) as opened:
        opened.write("*RST;*CLS")
        yield opened


def turned_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The small turn from one attitude to another, degrees about the camera's axes (3,)."""
    turn = multiply(second, conjugate(first))
    return -2 * np.degrees(turn[1:] * np.sign(turn[0]))


def test_a_test_stand_meets_an_instrument(stand):
    maker, model, serial, version = stand.ask("*IDN?").split(",")
    assert (maker, model, serial) == ("hilstar", "star display", "0") and version
    assert stand.ask("SYST:VERS?;*TST?;*ESR?;*STB?") == "1999.0;0;0;16"
    assert stand.ask(":SYSTem:ERRor?") == '0,"No error"'
    assert np.all(stand.numbers("TRAC:RES?") == NOT_A_NUMBER)
    assert int(stand.ask("FRAM:MISS?")) >= 0


def test_an_attitude_that_is_set_is_shown_and_turns_at_the_rate_that_is_set(
    scpi_steered_run, stand
):
    stand.write("SKY:ATT " + ",".join(map(str, ORION_Q)))
    assert stand.ask("*OPC?") == "1"
    shown = stand.numbers("SKY:ATT?")
    assert abs(abs(shown @ ORION_Q) - 1) < 1e-7  # of seven digits
    assert stand.ask("STAT:OPER:COND?;:STAT:QUES:COND?").split(";")[0] == str(256 + 512)
    stand.write("SKY:RATE 0, 0.5 DEG/S, -0.25;*WAI")
    assert stand.numbers("SKY:RATE?") == pytest.approx([0, 0.5, -0.25], abs=F32)
    begun_s = time.monotonic()
    first = stand.numbers("SKY:ATT?")
    time.sleep(0.5)
    turn = turned_deg(first, stand.numbers("SKY:ATT?"))
    lasted_s = time.monotonic() - begun_s
    assert turn[0] == pytest.approx(0, abs=1e-4) and turn[2] / turn[1] == pytest.approx(
        -0.5, rel=1e-3
    )
    assert 0 < turn[1] < 0.5 * (lasted_s + 0.3)  # a state is written ten times a second
    assert stand.errors() == [] and scpi_steered_run[0].count("sender's clock") == 0


def test_orders_are_those_of_the_operator(scpi_steered_run, stand):
    stand.write("SKY:BLANK ON")
    assert stand.ask("SKY:BLAN?") == "1" and int(stand.ask("STAT:OPER:COND?")) & 2048
    stand.write("SKY:FAULT 'dark'")
    assert stand.ask("SKY:FAUL?") == '"dark"'
    stand.write("sky:faul 'dark',off;blan 0;*opc")
    assert stand.ask("SKY:FAUL?;BLAN?") == '"";0'
    wait_for(lambda: int(stand.ask("*ESR?")) & 1, "*OPC")
    stand.write("LEDG:STATE OFF")
    assert stand.ask("LEDG:STAT?") == "0"
    stand.write("LEDG:STATE ON")
    assert stand.ask("LEDG:STAT?") == "1" and stand.errors() == []
    assert scpi_steered_run[0].count("blank on, by SCPI") == 1


def test_errors_are_the_standard_s_and_set_their_bits(stand):
    stand.write("*ESE 60;*SRE 32")
    for line, number in (
        ("SKY:NONE?", -113),
        ("SKY:ATT 1,1,1,1", -222),
        ("SKY:RATE 100,0,0", -222),
        ("SKY:FAUL 'darc'", -224),
        ("x" * 5000, -363),
    ):
        stand.write(line)
        assert stand.errors() == [number], line
    assert stand.ask("*STB?") == str(32 + 64) and stand.ask("*ESR?;*STB?") == f"{32 + 16 + 8};16"


def test_what_is_no_scpi_neither_ends_it_nor_makes_it_grow(scpi_steered_run):
    served, port = scpi_steered_run
    page = children(served.process.pid, "hilstar.server.console.server")[0]
    rng = np.random.default_rng(5025)

    def used_mb() -> float:
        return (
            int(Path(f"/proc/{page}/statm").read_text().split()[1]) * resource.getpagesize() / 1e6
        )

    def fuzz(size: int) -> None:
        for _ in range(4):
            data = rng.integers(256, size=size // 4, dtype=np.uint8)
            data[rng.random(len(data)) < 0.02] = ord("\n")
            with (
                socket.create_connection(("127.0.0.1", port), PATIENCE_S) as sender,
                contextlib.suppress(OSError),
            ):
                sender.sendall(data.tobytes() + b"\n")
                sender.shutdown(socket.SHUT_WR)
                while sender.recv(65536):
                    pass

    fuzz(FUZZ_BYTES // 4)
    before_mb = used_mb()
    fuzz(FUZZ_BYTES)
    unread = socket.create_connection(("127.0.0.1", port), PATIENCE_S)  # it asks, and never reads
    unread.settimeout(0.2)
    with contextlib.suppress(OSError):
        for _ in range(200):
            unread.sendall(b"*IDN?;" * 600 + b"\n")
    assert used_mb() < before_mb + RSS_MB
    # more than are let in
    idle = [socket.create_connection(("127.0.0.1", port), PATIENCE_S) for _ in range(20)]
    with instrument(port) as opened:
        assert opened.ask("*IDN?").startswith("hilstar")
    for each in (unread, *idle):
        each.close()
    assert (
        children(served.process.pid, "hilstar.server.console.server") == [page]
        and served.process.poll() is None
    )


@pytest.mark.parametrize(
    "request_line",
    [
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"POST /" + 5000 * b"a" + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"patch /a HTTP/1.1\r\n\r\n",
        b"\r\n\r\nPRI * HTTP/2.0\r\n\r\n",
        bytes.fromhex("16030100c8010000c40303"),
    ],
)
def test_a_browser_is_not_listened_to(scpi_steered_run, stand, request_line):
    with (
        socket.create_connection(("127.0.0.1", scpi_steered_run[1]), PATIENCE_S) as browser,
        contextlib.suppress(OSError),
    ):
        for piece in (request_line[:7], request_line[7:], b"\nSKY:BLAN ON\nSKY:BLAN?\n"):
            browser.sendall(piece)
            time.sleep(0.01)  # a segment of its own
        assert browser.recv(100) == b""
    assert stand.ask("SKY:BLAN?") == "0" and stand.errors() == []


def flooding(port: int, line: bytes, stop: threading.Event) -> None:
    """Pipeline a line from PEERS connections, made anew where they are closed; their answers are
    read and dropped.
    """
    peers: list[socket.socket] = []
    while not stop.is_set():
        while len(peers) < PEERS:
            peers.append(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
            peers[-1].setblocking(False)
        heard, ready, _ = select.select(peers, peers, [], 0.1)
        for peer in {*heard, *ready}:
            try:
                closed = peer in heard and not peer.recv(65536)
                if peer in ready and not closed:
                    peer.send(line)
            except OSError:
                closed = True
            if closed:
                peer.close()
                peers.remove(peer)
    for peer in peers:
        peer.close()


# The flooders and the run share the machine's cores: a few frames may wait for one. Peers that were
# obeyed had the sky stale for as long as they talked.
MAX_STALE_SHARE = 0.1


def counts_of_a_fresh_sky(page):
    """The run's counts once frames come and none of them is stale any more: the page's state is
    some frames old, and the sky was stale until the controller pointed it.
    """
    counts = page.json("/state")["state"]["counts"]
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        time.sleep(0.5)
        earlier = counts
        counts = page.json("/state")["state"]["counts"]
        if counts["frames"] > earlier["frames"] and counts["stale"] == earlier["stale"]:
            return counts
    raise AssertionError(counts)


@pytest.fixture(scope="module")
def open_scpi_run(tmp_path_factory):
    """A run that whoever has its token may steer, and its page."""
    folder = tmp_path_factory.mktemp("open")
    with scpi_run(folder, STEERED, "--console", "127.0.0.1:0", at="0.0.0.0:0") as (served, found):
        yield found, page_of(served), served.process.pid


@pytest.mark.parametrize(
    "line",
    [b"*IDN?\n" * 500, b"*IDN?;" * 600 + b"\n", b"\n" * 4000],
    ids=["lines", "one-line", "empty"],
)
def test_peers_without_the_token_neither_stop_the_sky_nor_displace_its_controller(
    open_scpi_run, line
):
    found, page, pid = open_scpi_run
    with instrument(int(found[2])) as stand, contextlib.ExitStack() as idle:
        stand.write(f'SYST:AUTH "{found[3]}";:SKY:ATT 1,0,0,0')
        assert stand.ask("*OPC?") == "1"
        before = counts_of_a_fresh_sky(page)
        for _ in range(PEERS):
            peer = socket.create_connection(("127.0.0.1", int(found[2])), PATIENCE_S)
            idle.enter_context(peer)
        stop = threading.Event()
        flood = threading.Thread(target=flooding, args=(int(found[2]), line, stop))
        flood.start()
        waits_s = []
        waited = idle.enter_context(CoreWaits(pid))
        try:
            for _ in range(ASKED):
                begun_s = time.monotonic()
                page.json("/health")
                waits_s.append(time.monotonic() - begun_s)
                time.sleep(0.05)
            after = page.json("/state")["state"]["counts"]
            # the same connection, still let in
            assert stand.ask("*IDN?").startswith("hilstar") and stand.errors() == []
        finally:
            stop.set()
            flood.join()
        frames = after["frames"] - before["frames"]
        stale = after["stale"] - before["stale"]
        assert frames > 0 and stale <= MAX_STALE_SHARE * frames, (before, after)
        assert np.median(waits_s) < HEALTH_S + waited.s / ASKED


def test_another_source_is_not_steered_and_a_page_may_stand_beside(tmp_path):
    source = '[attitude]\nendpoint = "ipc:///tmp/hilstar-no-sender-there"\n'
    with (
        scpi_run(tmp_path, source, "--console", "127.0.0.1:0") as (served, found),
        instrument(int(found[2])) as stand,
    ):
        stand.write("SKY:ATT 1,0,0,0;RATE 0,0,0")
        assert stand.errors() == [-221, -221]
        assert np.all(stand.numbers("SKY:ATT?") == NOT_A_NUMBER)
        wait_for(lambda: int(stand.ask("STAT:QUES:COND?")) & 512, served.lines)
        stand.write("SKY:BLANK ON")
        assert (
            stand.ask("SKY:BLANK?") == "1"
            and page_of(served).json("/state")["state"]["operator"]["blank"]
        )


def test_beyond_this_machine_it_asks_for_the_token(tmp_path):
    with (
        scpi_run(tmp_path, STEERED, at="0.0.0.0:0") as (_, found),
        instrument(int(found[2])) as stand,
    ):
        stand.write("SKY:ATT 1,0,0,0;BLANK ON;*RST")
        assert stand.errors() == [-203, -203, -203]
        stand.write('SYST:AUTH "guess"')
        assert stand.errors() == [-203]
        stand.write(f'SYST:AUTH "{found[3]}";:SKY:ATT 1,0,0,0')
        assert stand.errors() == [] and stand.ask("*OPC?") == "1"
        assert stand.numbers("SKY:ATT?") == pytest.approx([1, 0, 0, 0])


@pytest.mark.parametrize(
    ("attitude", "options", "words"),
    [
        (STEERED, [], ['source = "scpi"', "add --scpi"]),
        (
            STEERED + 'endpoint = "udp://127.0.0.1:1"\n',
            ["--scpi", "0"],
            ["endpoint", "--scpi HOST:PORT"],
        ),
        (STEERED + 'clock = "unix"\n', ["--scpi", "0"], ["clock", "remove it"]),
        ("", ["--scpi", "127.0.0.1:99999"], ["--scpi 127.0.0.1:99999", "127.0.0.1:5025"]),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(tmp_path, attitude, options, words):
    bench = tmp_path / "bench.toml"
    bench.write_text(LIVE_BENCH + attitude)
    done = run_hilstar_here("serve", bench, "--headless", *options)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert all(word in done.stderr for word in words), done.stderr
