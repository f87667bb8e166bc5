"""A SCPI connection without a network or a run: what it answers and orders by a run's state, the
attitudes that it sends, when a setting counts as shown, and who is closed where many come.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import socket
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.attitude.wire.packet import AttitudeSample, decode
from hilstar.basics.units import NS_PER_MS, NS_PER_S
from hilstar.server.answers.judge import TrackerFigures
from hilstar.server.console.messages import (
    BLANK,
    FRAME,
    HAS_AGE,
    MISSING,
    STALE,
    FrameNumbers,
    OrderAnswer,
    RunState,
    ScpiSetup,
    SharedMemory,
)
from hilstar.server.console.page_figures import RunCounts
from hilstar.server.console.protocol import LedgerState, NewestFrame, ShownAttitude
from hilstar.server.console.scpi import MAX_ERRORS, MAX_LINE_BYTES
from hilstar.server.console.server import scpi_server
from hilstar.server.console.server.scpi_server import (
    ALIVE_NS,
    MARGIN_NS,
    MAX_CONTROLLERS,
    MAX_STRANGERS,
    SETTLES_NS,
    Connection,
    Peers,
    ScpiServer,
)
from tests.support.waiting import PATIENCE_S

START_NS = 10**15
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
SHOWN = NewestFrame(number=5, missing=False, blank=False)
PACKET_ERROR_RAD = 1e-6  # a packet's rate is single precision
# of a run that is well: the bits of SCPI's registers that a device has for itself (docs/scpi.md)
SKY_BIT, LEDGER_BIT, FAULT_BIT, OPERATOR_BIT = 256, 512, 1024, 2048
NO_ATTITUDE_BIT, LEDGER_FAILS_BIT, MISSED_BIT, NOT_WELL_BIT = 512, 1024, 2048, 4096


class Bench:
    """A server of SCPI whose clock, run and operator are the test's: `orders` are those given, and
    `status` is their answers'.
    """

    def __init__(self, monkeypatch, receiver: socket.socket | None, **setup) -> None:
        self.now_ns = START_NS
        monkeypatch.setattr(scpi_server, "time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))
        monkeypatch.setattr(scpi_server, "WRONG_TOKEN_S", 0.0)
        monkeypatch.setattr(scpi_server, "TURN_S", 0.0)
        monkeypatch.setattr(scpi_server, "STRANGERS_S", 0.0)
        self.receiver = receiver
        port = 0 if receiver is None else receiver.getsockname()[1]
        self.reader = SimpleNamespace(seen=None, health=SimpleNamespace(ok=True))
        self.memory = SharedMemory.make(64)
        self.orders = []
        self.status = 200
        made = ScpiSetup(
            **{"token": "", "source": "zmq", "steer_port": port, "max_rate_deg_s": 20.0, **setup}
        )
        self.server = ScpiServer(made, self.reader, self.memory, self.give)
        self.client = self.join("127.0.0.1")

    def join(self, address: str) -> Connection:
        """A new connection."""
        client = Connection(self.server, address)
        transport = SimpleNamespace(abort=lambda: None)
        self.server.peers.enter(client, SimpleNamespace(transport=transport))
        return client

    async def give(self, order) -> OrderAnswer:
        """Take an operator's order."""
        self.orders.append(order)
        if self.reader.seen is not None:
            # the run's next state has its effect
            self.run(host_ns=self.now_ns + 1)
        return OrderAnswer(id=order.id, status=self.status, line="refused, it says")

    def run(self, **changes) -> None:
        """The run's state: as it was, with changes."""
        seen = self.reader.seen or RunState(
            host_ns=self.now_ns, alive_ns=self.now_ns, frame=SHOWN, counts=RunCounts(missed=7)
        )
        fields = {name: getattr(seen, name) for name in seen.__struct_fields__}
        self.reader.seen = RunState(**{**fields, **changes})

    def says(self, line: str, client: Connection | None = None) -> str:
        """The answers of a line."""
        return asyncio.run((client or self.client).answer(line))

    def errors(self, client: Connection | None = None) -> list[int]:
        """The numbers of the errors in a connection's queue, which this empties."""
        numbers: list[int] = []
        for _ in range(MAX_ERRORS + 1):
            number = int(self.says("SYST:ERR?", client).partition(",")[0])
            if not number:
                break
            numbers.append(number)
        return numbers

    def sent(self) -> list[AttitudeSample]:
        """The attitudes that came since the last call."""
        samples = []
        with contextlib.suppress(BlockingIOError):
            while True:
                samples.append(decode(self.receiver.recv(200)))
        return samples


@pytest.fixture
def receiver():
    """A run's UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        yield receiver


@pytest.fixture
def benches(monkeypatch):
    """Makes servers, which end with the test."""
    made = []

    def make(receiver: socket.socket | None, **setup) -> Bench:
        made.append(Bench(monkeypatch, receiver, **setup))
        return made[-1]

    yield make
    for bench in made:
        os.close(bench.memory.fd)
        if bench.server.sky is not None:
            bench.server.sky._socket.close()


@pytest.fixture
def bench(benches, receiver):
    """A server that may set the sky."""
    return benches(receiver)


def turned_rad(sample: AttitudeSample) -> float:
    """The turn from the upright attitude about z, rad."""
    w, x, y, z = sample.q_icrs_to_cam
    assert (x, y) == pytest.approx((0, 0), abs=PACKET_ERROR_RAD)
    return 2 * math.atan2(z, w)


def test_the_sky_turns_at_its_rate_from_each_setting_on(bench):
    bench.says("SKY:ATT 1,0,0,0")
    (set_sample,) = bench.sent()
    assert set_sample.discontinuity
    assert set_sample.t_ns == START_NS
    assert set_sample.q_icrs_to_cam.tolist() == list(UPRIGHT)
    bench.says("SKY:RATE 0,0,12")
    (turning,) = bench.sent()
    assert not turning.discontinuity
    np.testing.assert_allclose(
        turning.rate_cam_rad_s, [0, 0, math.radians(12)], rtol=PACKET_ERROR_RAD
    )
    bench.now_ns += 2 * NS_PER_S
    bench.server.sky.send()
    (later,) = bench.sent()
    # 24 degrees of the camera about its own z
    away_rad = turned_rad(later)
    assert abs(away_rad) == pytest.approx(math.radians(24), abs=PACKET_ERROR_RAD)
    # another rate goes on from there
    bench.says("SKY:RATE 0,0,-6")
    (back,) = bench.sent()
    assert turned_rad(back) == pytest.approx(away_rad, abs=PACKET_ERROR_RAD)
    bench.now_ns += 4 * NS_PER_S
    bench.server.sky.send()
    (home,) = bench.sent()
    assert turned_rad(home) == pytest.approx(0, abs=PACKET_ERROR_RAD)
    # an attitude jumps, and the rate stays
    bench.says("SKY:ATT 0,0,0,1")
    (jumped,) = bench.sent()
    assert jumped.discontinuity
    assert abs(turned_rad(jumped)) == pytest.approx(math.pi)
    assert jumped.rate_cam_rad_s[2] == pytest.approx(math.radians(-6))
    sequences = [sample.sequence for sample in (set_sample, turning, later, back, home, jumped)]
    assert sequences == list(range(6))
    assert not bench.errors()


def test_nothing_is_sent_before_an_attitude_and_a_wrong_one_is_refused(bench):
    bench.says("SKY:RATE 1,0,0")
    bench.server.sky.send()
    assert bench.sent() == []
    # 12, 12 and 12 deg/s are 20.8 together, over the 20 of the bench
    for line in ("SKY:RATE 12,12,12", "SKY:RATE 0,0,-20.1", "SKY:ATT 1,1,0,0"):
        bench.says(line)
        assert bench.errors() == [-222]
    bench.says("SKY:RATE 11,-11,11")
    assert bench.errors() == []
    assert bench.sent() == []


def test_a_sky_that_comes_otherwise_is_not_set(benches):
    bench = benches(None)
    for line in ("SKY:ATT 1,0,0,0", "SKY:RATE 0,0,0"):
        bench.says(line)
        assert bench.errors() == [-221]


@pytest.mark.parametrize(
    ("changes", "operation", "questionable"),
    [
        ({}, SKY_BIT, 0),
        ({"frame": NewestFrame(missing=False, blank=True)}, 0, 0),
        ({"frame": NewestFrame(missing=True, blank=False)}, SKY_BIT, NO_ATTITUDE_BIT),
        ({"frame": NewestFrame(missing=False, stale=True, blank=False)}, SKY_BIT, NO_ATTITUDE_BIT),
        ({"ledger": LedgerState("a", 1, "")}, SKY_BIT | LEDGER_BIT, 0),
        ({"ledger": LedgerState("a", 1, "full")}, SKY_BIT | LEDGER_BIT, LEDGER_FAILS_BIT),
        ({"faults": ["dust"]}, SKY_BIT | FAULT_BIT, 0),
        ({"operator_text": "blank"}, SKY_BIT | OPERATOR_BIT, 0),
        ({"counts": RunCounts(missed=8)}, SKY_BIT, MISSED_BIT),
    ],
)
def test_the_registers_have_the_run_s_conditions(bench, changes, operation, questionable):
    bench.run()
    bench.server._look()  # seven frames were missed until here
    bench.run(**changes)
    assert bench.server.conditions() == (operation, questionable)
    bench.reader.health.ok = False
    assert bench.server.conditions() == (operation, questionable | NOT_WELL_BIT)
    assert bench.says("STAT:OPER:COND?;:STAT:QUES:COND?") == (
        f"{operation};{questionable | NOT_WELL_BIT}"
    )


def test_a_run_without_a_state_is_not_well(bench):
    assert bench.server.conditions() == (0, NO_ATTITUDE_BIT | NOT_WELL_BIT)
    assert bench.says("*TST?") == "1"


@pytest.mark.parametrize(
    ("state_age_ns", "step_age_ns", "answer"),
    [
        (0, 0, "0"),
        (ALIVE_NS - 1, ALIVE_NS - 1, "0"),
        (ALIVE_NS, 0, "1"),
        (0, ALIVE_NS, "1"),
    ],
)
def test_a_self_test_fails_where_the_state_or_the_frame_loop_stands(
    bench, state_age_ns, step_age_ns, answer
):
    state_ns = bench.now_ns - state_age_ns
    bench.run(host_ns=state_ns, alive_ns=state_ns - step_age_ns)
    assert bench.says("*TST?") == answer


def newest_frame(bench: Bench, *, draw_ns=0, swap_ns=0, age_ns=0, flags=HAS_AGE) -> None:
    """A frame in the run's memory."""
    numbers = FrameNumbers(1, draw_ns, swap_ns, swap_ns, age_ns, 0, 1, 0, 0, flags)
    bench.memory.frames.put(FRAME.pack(*numbers))


def test_a_setting_is_shown_by_a_frame_of_its_attitude_and_a_later_state(bench):
    assert not bench.server.pending()
    bench.says("SKY:ATT 1,0,0,0")
    assert bench.server.pending()
    bench.run(host_ns=START_NS + NS_PER_S)
    # a swap after the setting, of an attitude from before it
    newest_frame(bench, draw_ns=START_NS + 9, swap_ns=START_NS + 9, age_ns=10)
    assert bench.server.pending()
    bench.run(host_ns=START_NS)
    newest_frame(bench, draw_ns=START_NS + 1, swap_ns=START_NS + 10, age_ns=10)
    assert bench.server.pending()  # the state is of before it
    bench.run(host_ns=START_NS + MARGIN_NS)
    assert bench.server.pending()
    bench.run(host_ns=START_NS + MARGIN_NS + 1)
    assert not bench.server.pending()


@pytest.mark.parametrize(
    ("flags", "operator"), [(BLANK, {"blank": True}), (HAS_AGE, {"pause": True})]
)
def test_a_blank_or_paused_sky_is_set_once_a_frame_is_drawn_after_it(bench, flags, operator):
    bench.says("SKY:ATT 1,0,0,0")
    bench.run(operator=operator, host_ns=START_NS + NS_PER_S)
    newest_frame(bench, draw_ns=START_NS - 1, swap_ns=START_NS + NS_PER_MS, flags=flags)
    assert bench.server.pending()
    newest_frame(bench, draw_ns=START_NS, swap_ns=START_NS + 1, age_ns=NS_PER_S, flags=flags)
    assert not bench.server.pending()


@pytest.mark.parametrize("flags", [MISSING | BLANK, STALE | BLANK])
def test_a_frame_that_was_drawn_before_the_run_heard_of_an_attitude_does_not_show_it(bench, flags):
    """The frame is begun after the setting, and the setting's packet is still on its way."""
    bench.run(host_ns=START_NS + NS_PER_S)
    bench.says("SKY:RATE 0,0,1")
    newest_frame(bench, draw_ns=START_NS, swap_ns=START_NS + 1, flags=flags)
    assert not bench.server.pending()  # without an attitude no frame shows a rate
    bench.now_ns += 1
    bench.says("SKY:ATT 1,0,0,0")
    newest_frame(bench, draw_ns=bench.now_ns + 5, swap_ns=bench.now_ns + 6, flags=flags)
    assert bench.server.pending()
    newest_frame(bench, draw_ns=bench.now_ns + 7, swap_ns=bench.now_ns + 8)
    assert not bench.server.pending()


def test_a_setting_that_is_never_shown_is_an_error_and_not_waited_for(bench, monkeypatch):
    bench.says("SKY:ATT 1,0,0,0")
    bench.run()

    async def hurry(seconds: float) -> None:
        bench.now_ns += NS_PER_S // 2

    monkeypatch.setattr(scpi_server.asyncio, "sleep", hurry)
    assert bench.says("*OPC?") == "1"
    assert bench.now_ns - START_NS > SETTLES_NS
    assert bench.errors() == [-365]


def test_opc_completes_once_the_sky_is_as_it_was_set(bench):
    bench.run()
    bench.says("SKY:ATT 1,0,0,0;*OPC")
    assert bench.says("*ESR?") == "0"
    newest_frame(bench, draw_ns=START_NS, swap_ns=START_NS + 10, age_ns=10)
    bench.server._look()
    bench.run(host_ns=START_NS + NS_PER_S)
    bench.server._look()
    assert bench.says("*ESR?;*ESR?") == "1;0"


def test_switches_and_faults_are_an_operator_s_orders(bench):
    bench.run(operator={"blank": True, "ledger": False, "pause": True}, faults=["dust", "haze"])
    far = bench.join("10.0.0.9")
    bench.says("SKY:BLAN ON;:LEDG:STAT OFF", far)
    bench.says('SKY:FAUL "dust";FAUL "haze",OFF')
    orders = [(order.name, order.on, order.fault, order.who) for order in bench.orders]
    assert orders == [
        ("blank", True, "", "SCPI (10.0.0.9)"),
        ("ledger", False, "", "SCPI (10.0.0.9)"),
        ("fault", True, "dust", "SCPI"),
        ("fault", False, "haze", "SCPI"),
    ]
    bench.orders.clear()
    bench.says("SKY:ATT 1,0,0,0")
    bench.says("SKY:RATE 0,0,3;*RST")
    # what is on goes off; an attitude stays
    orders = [(order.name, order.on, order.fault) for order in bench.orders]
    assert orders == [
        ("blank", False, ""),
        ("pause", False, ""),
        ("fault", False, "dust"),
        ("fault", False, "haze"),
    ]
    assert bench.sent()[-1].rate_cam_rad_s.tolist() == [0, 0, 0]
    assert bench.errors() == bench.errors(far) == []


@pytest.mark.parametrize(
    ("status", "number"), [(404, -224), (409, -221), (500, -250), (504, -365), (418, -310)]
)
def test_an_order_that_is_refused_has_its_standard_error(bench, status, number):
    bench.run()
    bench.status = status
    bench.says("SKY:BLAN ON")
    assert bench.errors() == [number]


@pytest.mark.parametrize(
    ("line", "number"),
    [
        ("SYST:AUTH token", -104),
        ("SKY:FAUL dust", -104),
        ('SKY:BLAN "ON"', -158),
        ("SKY:BLAN PERHAPS", -224),
        ("SKY:FAUL", -109),
        ('SKY:FAUL "dust",ON,OFF', -108),
        ("SKY:BLAN", -109),
        ("SKY:ATT 1,0,0", -109),
        ("SKY:ATT 1,0,0,0,0", -108),
        ("SKY:ATT 2,0,0,0", -222),
        ("SKY:RATE 0,0,20.1", -222),
        ("SKY:RATE 0,0,1 V", -131),
        ("SKY:NOWH", -113),
        (None, -363),  # a line that was too long
    ],
)
def test_what_is_wrong_in_a_line_is_its_standard_error_and_does_nothing(bench, line, number):
    bench.run()
    bench.says(line)
    assert bench.errors() == [number]
    assert bench.orders == [] and bench.sent() == []


def test_queries_answer_by_the_run_s_state(bench):
    attitude = ShownAttitude(
        q=(0.5, 0.5, -0.5, 0.5),
        ra_deg=0.0,
        dec_deg=0.0,
        roll_deg=0.0,
        rate_deg_s=[1.0, -2.5, 0.0],
        age_ms=1.0,
    )
    tracker = TrackerFigures(residual_arcsec=[0.5, -1.25, 60.0])
    bench.run(attitude=attitude, tracker=tracker, faults=['a "b"', "c"], operator={"blank": True})
    numbers = [float(text) for text in bench.says("SKY:ATT?").split(",")]
    assert numbers == [0.5, 0.5, -0.5, 0.5]
    assert [float(text) for text in bench.says("SKY:RATE?").split(",")] == [1.0, -2.5, 0.0]
    assert [float(text) for text in bench.says("TRAC:RES?").split(",")] == [0.5, -1.25, 60.0]
    assert bench.says("SKY:FAUL?") == '"a ""b""","c"'
    assert bench.says("SKY:BLAN?;:LEDG:STAT?;:FRAM:MISS?") == "1;0;7"
    bench.run(ledger=LedgerState("a", 1, ""), attitude=None, tracker=None, faults=[])
    assert bench.says("LEDG:STAT?;:SKY:FAUL?") == '1;""'
    # SCPI's number for "not a number", for each of them
    assert bench.says("SKY:ATT?") == ",".join(["9.91E37"] * 4)
    assert bench.says("SKY:RATE?") == bench.says("TRAC:RES?") == ",".join(["9.91E37"] * 3)


def test_answers_are_a_line_s_own_and_a_message_waits_after_the_first(bench):
    bench.run()
    assert bench.says("*OPC?;*STB?") == "1;16"
    assert bench.says("*STB?") == "0"
    assert bench.says("SYST:VERS?;*ESE 36;*ESE?;*SRE 255;*SRE?") == "1999.0;36;191"
    assert bench.says("SYST:VERS? 3") == ""
    assert bench.errors() == [-108]


def test_a_token_is_asked_for_and_a_wrong_one_counts(benches, receiver):
    bench = benches(receiver, token="secret")
    bench.run()
    assert bench.says("*STB?;SKY:BLAN ON") == ""
    assert bench.errors() == [-203, -203]
    assert bench.orders == []
    bench.says('SYST:AUTH "wrong"')
    assert bench.client.wrong_tokens == 1
    assert not bench.client.unlocked
    assert not bench.client.is_controller
    assert bench.errors() == [-203]
    bench.says('SYST:AUTH "secret";:SKY:BLAN ON')
    assert bench.errors() == []
    assert [order.name for order in bench.orders] == ["blank"]
    assert bench.client in bench.server.peers.controllers
    stranger = bench.join("10.0.0.1")
    assert bench.says("SYST:VERS?", stranger) == "1999.0"
    assert stranger in bench.server.peers.strangers


class Peer:
    """One end of a connection from an address."""

    def __init__(self, address: str) -> None:
        self.address = address


def way_out(closed: list[str], name: str) -> SimpleNamespace:
    """A connection's way out, which adds its name to `closed` when it is cut."""
    return SimpleNamespace(transport=SimpleNamespace(abort=lambda: closed.append(name)))


def test_the_one_that_is_silent_longest_gives_way():
    closed: list[str] = []
    peers = Peers()
    clients = {}
    for number in range(MAX_STRANGERS):
        # the last two are of another address
        address = "10.0.0.2" if number >= MAX_STRANGERS - 2 else "10.0.0.1"
        clients[number] = Peer(address)
        peers.enter(clients[number], way_out(closed, f"stranger {number}"))
    peers.heard(clients[0])
    late = Peer("10.0.0.2")
    peers.enter(late, way_out(closed, "late"))
    assert closed == ["stranger 1"]
    assert clients[0] in peers.strangers
    controllers = []
    for number in range(MAX_CONTROLLERS):
        client = Peer("10.0.0.3")
        peers.enter(client, way_out(closed, f"controller {number}"))
        peers.promote(client)
        controllers.append(client)
    closed.clear()
    peers.heard(controllers[0])
    peers.promote(controllers[2])  # it is one
    peers.promote(late)
    assert closed == ["controller 1"]
    assert late in peers.controllers
    assert late not in peers.strangers
    peers.leave(late)
    assert late not in peers.controllers


def test_a_controller_s_turn_is_twice_a_stranger_s_and_strangers_wait_for_each_other(monkeypatch):
    """A stranger's turn comes 5 ms after the one before, whoever's that was."""
    now_s = 100.0
    slept_s: list[float] = []

    async def sleep(seconds: float) -> None:
        nonlocal now_s
        slept_s.append(seconds)
        now_s += max(seconds, 0.0)

    async def take_turns() -> list[int]:
        asyncio.get_running_loop().time = lambda: now_s
        turns = scpi_server.Turns()
        return [await turns.await_turn(stranger) for stranger in (False, True, True, False, True)]

    monkeypatch.setattr(scpi_server.asyncio, "sleep", sleep)
    assert asyncio.run(take_turns()) == [8, 4, 4, 8, 4]
    controller_s, first_s, *later_s = slept_s
    assert controller_s == scpi_server.TURN_S and first_s <= 0.0
    after_controller_s = scpi_server.STRANGERS_S - scpi_server.TURN_S
    assert later_s == pytest.approx(
        [scpi_server.STRANGERS_S, scpi_server.TURN_S, after_controller_s], abs=1e-9
    )


def test_a_connection_waits_for_a_turn_as_what_it_is(benches):
    bench = benches(None, token="open")
    waited: list[bool] = []

    async def await_turn(stranger: bool) -> int:
        waited.append(stranger)
        return 3

    bench.server.turns = SimpleNamespace(await_turn=await_turn)
    # a line and its two queries are three units
    assert bench.says("*IDN?;SYST:VERS?").endswith(";1999.0")
    assert waited == [True]
    bench.says('SYST:AUTH "open"')
    bench.says("*CLS")
    assert waited == [True, True, False]


def test_a_connection_that_ends_leaves_its_place():
    peers = Peers()
    clients = [Peer(f"10.0.0.{k}") for k in range(3)]
    for client in clients:
        peers.enter(client, SimpleNamespace(transport=None))
    peers.promote(clients[1])
    peers.leave(clients[0])
    peers.leave(clients[1])
    peers.leave(clients[1])
    assert (list(peers.controllers), list(peers.strangers)) == ([], [clients[2]])
    # one that has ended is promoted to nothing
    peers.promote(clients[0])
    assert list(peers.controllers) == []


def talked(bench: Bench, *lines: bytes) -> bytes:
    """What comes back over TCP until the server closes, or this side is done."""

    async def talk() -> bytes:
        listener = socket.create_server(("127.0.0.1", 0))
        serving = asyncio.create_task(bench.server.serve(listener))
        incoming, outgoing = await asyncio.open_connection(*listener.getsockname())
        for line in lines:
            outgoing.write(line)
            await outgoing.drain()
        outgoing.write_eof()
        try:
            async with asyncio.timeout(PATIENCE_S):
                told = await incoming.read()
                while bench.server.peers.strangers.keys() - {bench.client}:
                    await asyncio.sleep(0)
        except ConnectionResetError:
            told = b"reset"
        outgoing.close()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        return told

    return asyncio.run(talk())


def test_lines_over_tcp_are_answered_one_by_one_however_they_are_cut(benches):
    bench = benches(None)
    bench.run()
    told = talked(bench, b"*IDN?;SYST:VE", b"RS?\nSKY:BLAN?\r\n*CLS\n", b"FRAM:MISS?\n")
    first, *rest = told.decode().splitlines()
    assert first.startswith("hilstar,") and first.endswith(";1999.0")
    assert rest == ["0", "7"]


def test_a_line_that_is_too_long_is_an_error_and_the_next_is_answered(benches):
    bench = benches(None)
    bench.run()
    told = talked(bench, b"*IDN? " + b"x" * MAX_LINE_BYTES + b"\nSYST:ERR?\nSYST:ERR?\n")
    error, none = told.decode().splitlines()
    assert error.startswith("-363,") and str(MAX_LINE_BYTES) in error
    assert none.startswith("0,")


def test_who_guesses_tokens_is_closed_after_five(benches):
    bench = benches(None, token="right")
    wrong = b'SYST:AUTH "wrong"\n'
    told = talked(bench, wrong * 4 + b"*IDN?\n" + wrong + b"*IDN?\n")
    assert told.count(b"hilstar,") == 1


def test_a_browser_s_request_gets_no_answer(benches):
    bench = benches(None)
    told = talked(bench, b"GET / HTTP/1.1\r\nHost: x\r\n\r\n*IDN?\n")
    assert told in {b"", b"reset"}
    assert not bench.server.peers.controllers


def test_attitudes_are_sent_again_and_again_while_a_server_serves(benches, receiver):
    bench = benches(receiver)
    bench.says("SKY:ATT 1,0,0,0")

    async def serve() -> list[int]:
        listener = socket.create_server(("127.0.0.1", 0))
        serving = asyncio.create_task(bench.server.serve(listener))
        sequences: list[int] = []
        async with asyncio.timeout(PATIENCE_S):
            while len(sequences) < 4:
                sequences += [sample.sequence for sample in bench.sent()]
                await asyncio.sleep(0.001)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        return sequences

    assert asyncio.run(serve())[:4] == [0, 1, 2, 3]


def test_a_frame_that_is_missed_is_in_the_register_until_the_next_look(bench):
    bench.run(counts=RunCounts(missed=7))
    bench.server._look()
    bench.says("STAT:QUES:EVEN?")  # read, and cleared
    bench.run(counts=RunCounts(missed=9))
    bench.server._look()
    assert int(bench.says("STAT:QUES:EVEN?")) & MISSED_BIT
    bench.server._look()
    assert not int(bench.says("STAT:QUES:EVEN?")) & MISSED_BIT
